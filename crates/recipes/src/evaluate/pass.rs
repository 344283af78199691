//! One pass over the pictures for all metrics.

use std::collections::BTreeMap;
use std::ops::Range;

use anyhow::{Context, bail};
use metrics::{
    FrameRule, ImageSize, MetricChoice, PictureStep, Protocol, Raster, ResizeFilter, Seam, ViewRule, seam, seam_pairs,
};
use rayon::prelude::*;

use super::network::{NetworkFolder, network_input};
use super::scalar::{ScalarMetric, prepared};
use super::source::{Instant, PictureSource, Shot};
use super::streams::{FeatureStream, SeamStream, Side};

/// Instants that are in memory at once, per thread.
const WINDOW_PER_THREAD: usize = 2;

/// What is computed, and how.
#[derive(Debug, Clone)]
pub struct PassOptions {
    /// Asked for, in this order.
    pub protocols: Vec<Protocol>,
    /// Pictures of both sides are first brought to these rows and columns.
    pub size: Option<[usize; 2]>,
    /// Pictures that go through a network at once.
    pub batch: usize,
    /// Of the choice of samples for metrics of pairs.
    pub seed: u64,
    /// Worst pairs that are remembered.
    pub worst: usize,
}

/// All collectors of one evaluation.
pub struct Pass {
    /// One per protocol of pairs.
    pub scalars: Vec<ScalarMetric>,
    /// Networks over pictures and clips.
    pub streams: Vec<FeatureStream>,
    /// View consistency.
    pub seams: Option<SeamStream>,
    /// Steps before everything else.
    first: Vec<PictureStep>,
    /// Frames and pictures seen of the generated side, or of the real one where there is no other.
    pub frames: u64,
    /// Pictures seen, alike.
    pub pictures: u64,
    /// Why something did not count, and how often.
    pub skipped: BTreeMap<String, u64>,
}

/// What the threads prepare of one side of an instant.
struct Prepared {
    /// Per stream: channel, name and input of each picture.
    inputs: Vec<Vec<(String, String, Vec<f32>)>>,
    seams: Vec<Seam>,
    pictures: u64,
}

impl Pass {
    /// Loads the networks that the protocols need.
    ///
    /// # Errors
    /// Missing or wrong weights; protocols that this program cannot compute yet.
    pub fn new(options: &PassOptions, networks: &NetworkFolder) -> anyhow::Result<Self> {
        let filter = ResizeFilter::PilBilinear;
        let first = options.size.map(|[height, width]| PictureStep::Resize { filter, height, width });
        let mut pass = Self {
            scalars: Vec::new(),
            streams: Vec::new(),
            seams: None,
            first: first.into_iter().collect(),
            frames: 0,
            pictures: 0,
            skipped: BTreeMap::new(),
        };
        for protocol in &options.protocols {
            pass.open(protocol, options, networks).with_context(|| format!("protocol {}", protocol.name))?;
        }
        Ok(pass)
    }

    fn open(&mut self, protocol: &Protocol, options: &PassOptions, networks: &NetworkFolder) -> anyhow::Result<()> {
        if let Some(scalar) = ScalarMetric::of(protocol, options.worst, networks)? {
            self.scalars.push(scalar);
            return Ok(());
        }
        match &protocol.metric {
            MetricChoice::Mvsc | MetricChoice::Vms => {
                if self.seams.is_none() {
                    self.seams = Some(SeamStream::new(networks.matcher()?));
                }
            }
            _ if self.stream_of(protocol).is_some() => {}
            metric => {
                let Some(feature) = protocol.feature() else { return Ok(()) };
                let clip = if let MetricChoice::Fvd { clip, .. } = metric { Some(*clip) } else { None };
                let loaded = if clip.is_some() { networks.clips(feature)? } else { networks.pictures(feature)? };
                self.streams.push(FeatureStream::new(protocol, loaded, clip, options.batch, options.seed));
            }
        }
        Ok(())
    }

    /// The stream whose features a protocol compares.
    pub fn stream_of(&self, protocol: &Protocol) -> Option<&FeatureStream> {
        let clip = if let MetricChoice::Fvd { clip, .. } = &protocol.metric { Some(*clip) } else { None };
        let same = |other: &Protocol| {
            (other.feature(), &other.real, &other.generated, other.frames, other.views)
                == (protocol.feature(), &protocol.real, &protocol.generated, protocol.frames, protocol.views)
        };
        self.streams.iter().find(|stream| stream.clip == clip && same(&stream.protocol))
    }

    /// Walks over both sides together; the instants must have the same names.
    ///
    /// # Errors
    /// Names, cameras or sizes that do not fit, and whatever pictures and networks report.
    pub fn paired(&mut self, real: &dyn PictureSource, generated: &dyn PictureSource) -> anyhow::Result<()> {
        same_names(real, generated)?;
        for scene in generated.scenes() {
            self.next_scene();
            for window in windows(scene) {
                let work: Vec<_> = window
                    .into_par_iter()
                    .map(|index| {
                        let (real, generated) = (self.read(real, index)?, self.read(generated, index)?);
                        let values = self.pair_values(&real, &generated)?;
                        let sides = [self.prepare(Side::Real, &real)?, self.prepare(Side::Generated, &generated)?];
                        anyhow::Ok((index, values, sides))
                    })
                    .collect::<anyhow::Result<_>>()?;
                for (index, values, [real, generated]) in work {
                    for (at, channel, value) in values {
                        if let Some(scalar) = self.scalars.get_mut(at) {
                            scalar.add(value, index, &channel);
                        }
                    }
                    self.count(&generated);
                    self.take(Side::Real, real)?;
                    self.take(Side::Generated, generated)?;
                }
            }
        }
        self.finish()
    }

    /// Walks over one side alone.
    ///
    /// # Errors
    /// Whatever pictures and networks report.
    pub fn alone(&mut self, side: Side, source: &dyn PictureSource) -> anyhow::Result<()> {
        for scene in source.scenes() {
            self.next_scene();
            for window in windows(scene) {
                let work: Vec<Prepared> = window
                    .into_par_iter()
                    .map(|index| self.prepare(side, &self.read(source, index)?))
                    .collect::<anyhow::Result<_>>()?;
                for prepared in work {
                    if side == Side::Generated {
                        self.count(&prepared);
                    }
                    self.take(side, prepared)?;
                }
            }
        }
        self.finish()
    }

    fn next_scene(&mut self) {
        self.streams.iter_mut().for_each(FeatureStream::next_scene);
    }

    fn count(&mut self, prepared: &Prepared) {
        self.frames += 1;
        self.pictures += prepared.pictures;
        if prepared.pictures == 0 {
            *self.skipped.entry("frames without any picture".to_owned()).or_default() += 1;
        }
    }

    fn read(&self, source: &dyn PictureSource, index: usize) -> anyhow::Result<Instant> {
        let mut instant = source.instant(index)?;
        if !self.first.is_empty() {
            for shot in &mut instant.views {
                shot.picture = prepared(&shot.picture, &self.first)?;
            }
        }
        Ok(instant)
    }

    fn pair_values(&self, real: &Instant, generated: &Instant) -> anyhow::Result<Vec<(usize, String, f64)>> {
        let mut values = Vec::new();
        for shot in &generated.views {
            let other = real.views.iter().find(|other| other.channel == shot.channel);
            let other =
                other.with_context(|| format!("{}: the real side has no camera {}", real.name, shot.channel))?;
            for (at, scalar) in self.scalars.iter().enumerate() {
                let place = || format!("{} {}", generated.name, shot.channel);
                let value = scalar.measure(&other.picture, &shot.picture).with_context(place)?;
                values.push((at, shot.channel.clone(), value));
            }
        }
        Ok(values)
    }

    fn prepare(&self, side: Side, instant: &Instant) -> anyhow::Result<Prepared> {
        let inputs = self.streams.iter().map(|stream| inputs(stream, side, instant)).collect::<anyhow::Result<_>>()?;
        let seams = if self.seams.is_some() { seams_of(instant)? } else { Vec::new() };
        Ok(Prepared { inputs, seams, pictures: instant.views.len() as u64 })
    }

    fn take(&mut self, side: Side, prepared: Prepared) -> anyhow::Result<()> {
        for (stream, inputs) in self.streams.iter_mut().zip(prepared.inputs) {
            for (channel, name, input) in inputs {
                stream.add(side, &channel, name, input)?;
            }
        }
        match &mut self.seams {
            Some(seams) => seams.add(side, &prepared.seams),
            None => Ok(()),
        }
    }

    fn finish(&mut self) -> anyhow::Result<()> {
        self.streams.iter_mut().try_for_each(FeatureStream::finish)
    }
}

/// Pictures of an instant that a stream counts, as its network wants them.
fn inputs(stream: &FeatureStream, side: Side, instant: &Instant) -> anyhow::Result<Vec<(String, String, Vec<f32>)>> {
    let protocol = &stream.protocol;
    if protocol.frames == FrameRule::KeyFrames && !instant.key_frame {
        return Ok(Vec::new());
    }
    let chosen = |(at, _): &(usize, &Shot)| protocol.views == ViewRule::All || *at == instant.front;
    let steps = if side == Side::Real { &protocol.real } else { &protocol.generated };
    let one = |(_, shot): (usize, &Shot)| {
        let name = format!("{} {}", instant.name, shot.channel);
        let picture = prepared(&shot.picture, steps).with_context(|| name.clone())?;
        Ok((shot.channel.clone(), name, network_input(&picture, stream.loaded.network.feature())))
    };
    instant.views.iter().enumerate().filter(chosen).map(one).collect()
}

fn seams_of(instant: &Instant) -> anyhow::Result<Vec<Seam>> {
    let pairs = seam_pairs(&instant.right_of, &vec![true; instant.views.len()]);
    let planes = |picture: &Raster<u8>| picture.map(|value| f32::from(value) / 255.0).planes();
    let mut seams = Vec::new();
    for (view, right) in pairs {
        let (Some(view), Some(right)) = (instant.views.get(view), instant.views.get(right)) else { continue };
        let size = |shot: &Shot| ImageSize { channels: 3, height: shot.picture.height, width: shot.picture.width };
        if size(view) != size(right) {
            bail!(
                "{}: cameras {} and {} have pictures of different sizes; bring them to one with --size HxW",
                instant.name,
                view.channel,
                right.channel
            );
        }
        seams.push(
            seam(&planes(&view.picture), &planes(&right.picture), size(view)).with_context(|| instant.name.clone())?,
        );
    }
    Ok(seams)
}

fn windows(scene: Range<usize>) -> Vec<Range<usize>> {
    let step = WINDOW_PER_THREAD * rayon::current_num_threads().max(1);
    let end = scene.end;
    scene.step_by(step).map(|start| start..(start + step).min(end)).collect()
}

fn same_names(real: &dyn PictureSource, generated: &dyn PictureSource) -> anyhow::Result<()> {
    let cure = "pairs need the same names on both sides; use --unpaired for metrics of whole sets only";
    if real.len() != generated.len() {
        bail!(
            "{} has {} frames, {} has {}; {cure}",
            real.describe(),
            real.len(),
            generated.describe(),
            generated.len()
        );
    }
    for index in 0..real.len() {
        let (a, b) = (real.name(index)?, generated.name(index)?);
        if a != b {
            bail!("frame {index} is {a} in {} and {b} in {}; {cure}", real.describe(), generated.describe());
        }
    }
    Ok(())
}
