//! Host arrays of one batch: rigs with different numbers of cameras, padded to V views.
//!
//! Shapes: B batch, V views, H W pixels.

use geometry::CameraRig;

use crate::{DataError, FrameId, ImageSize, PoseMode, Sample, SampleOptions, SampleView, SceneFrame, rerig};

/// How many views a batch has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PadViews {
    /// As many as its largest sample.
    #[default]
    Largest,
    /// Always this many, so that shapes never change.
    To(usize),
}

/// One batch on the host; the arrays are ready to become tensors.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneBatch {
    /// Where the samples come from, B entries.
    pub ids: Vec<FrameId>,
    /// Reference instants, B entries.
    pub timestamps_ns: Vec<i64>,
    /// Camera names, B lists without padding.
    pub channels: Vec<Vec<String>>,
    /// Scene descriptions, B entries.
    pub texts: Vec<Option<String>>,
    /// What is encoded.
    pub input: ViewArrays,
    /// What is decoded.
    pub target: ViewArrays,
    /// How the samples form clips; `None` for a batch of single frames. With clips of T frames every B above and in the arrays stands
    /// for clips × T, the frames of a clip one after another: `images` is `[B, T, V, 3, H, W]` in memory.
    pub clips: Option<ClipArrays>,
}

/// Time and motion of the frames of clips; B clips of T frames.
#[derive(Debug, Clone, PartialEq)]
pub struct ClipArrays {
    /// B.
    pub clips: usize,
    /// T.
    pub frames: usize,
    /// `[B, T]` seconds since the first frame of the clip.
    pub elapsed_secs: Vec<f32>,
    /// `[B, T, 4, 4]`: maps points of the previous frame's ego frame to this frame's, metres; the identity for the first frame.
    pub ego_from_previous_ego: Vec<f32>,
}

impl ClipArrays {
    /// Of samples that follow one another clip by clip.
    fn of(samples: &[Sample], frames: usize) -> Self {
        let mut arrays =
            Self { clips: samples.len() / frames, frames, elapsed_secs: Vec::new(), ego_from_previous_ego: Vec::new() };
        for clip in samples.chunks_exact(frames) {
            let mut previous = &clip[0];
            for sample in clip {
                arrays.elapsed_secs.push(((sample.timestamp_ns - clip[0].timestamp_ns) as f64 * 1e-9) as f32);
                let motion = sample.world_from_ego.inverse() * previous.world_from_ego;
                arrays.ego_from_previous_ego.extend(motion.to_rows().as_flattened().iter().map(|value| *value as f32));
                previous = sample;
            }
        }
        arrays
    }
}

/// Pictures and matrices of B × V views, row-major. A view that is padding, that has no picture or that was dropped has mask `false`,
/// black pixels, identity matrices and zero projections, so that it is visible nowhere.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewArrays {
    /// B.
    pub batch: usize,
    /// V.
    pub views: usize,
    /// H.
    pub height: usize,
    /// W.
    pub width: usize,
    /// `[B, V, 3, H, W]` RGB in [0, 1].
    pub images: Vec<f32>,
    /// `[B, V]`, true where a view counts.
    pub mask: Vec<bool>,
    /// `[B, V, H, W]`, true where a pixel counts: false in views that do not, and where the dataset says to ignore it (blurred faces,
    /// the own car). What a loss or metric compares must be chosen by it.
    pub pixel_mask: Vec<bool>,
    /// `[B, V, 3, 3]` camera matrix of the raw picture, px.
    pub k: Vec<f32>,
    /// `[B, V, 4, 4]` pose, metres.
    pub ego_from_cam: Vec<f32>,
    /// `[B, V, 3, 3]` raw to network pixels, flips included.
    pub img_from_raw: Vec<f32>,
    /// `[B, V, 3, 4]`: `(u·z, v·z, z) = img_from_ego · (p, 1)` in network pixels.
    pub img_from_ego: Vec<f32>,
    /// `[B, V, 3, 4]`: `p = ego_from_img · (u·z, v·z, z, 1)` in ego metres.
    pub ego_from_img: Vec<f32>,
}

impl ViewArrays {
    /// All padding.
    pub fn padding(batch: usize, views: usize, size: ImageSize) -> Self {
        let (height, width) = (size.height as usize, size.width as usize);
        let count = batch * views;
        let identity = |n: usize| {
            let one: Vec<f32> = (0..n * n).map(|i| if i % (n + 1) == 0 { 1.0 } else { 0.0 }).collect();
            one.repeat(count)
        };
        Self {
            batch,
            views,
            height,
            width,
            images: vec![0.0; count * 3 * height * width],
            mask: vec![false; count],
            pixel_mask: vec![false; count * height * width],
            k: identity(3),
            ego_from_cam: identity(4),
            img_from_raw: identity(3),
            img_from_ego: vec![0.0; count * 12],
            ego_from_img: vec![0.0; count * 12],
        }
    }

    /// Cameras without pictures (black), one rig per sample: what to decode when no truth is needed. Lenses are ignored: the decoder
    /// paints pinhole pictures with the same K.
    ///
    /// # Errors
    /// [`DataError::Config`] where a rig has more cameras than [`PadViews::To`] allows.
    pub fn cameras(rigs: &[CameraRig], size: ImageSize, pad: PadViews) -> Result<Self, DataError> {
        let blank = std::sync::Arc::new(vec![0.0; 3 * size.height as usize * size.width as usize]);
        let samples: Vec<Vec<SampleView>> = rigs
            .iter()
            .map(|rig| {
                let view = |camera| SampleView { image: Some(blank.clone()), ..SampleView::of_camera(camera, size) };
                rig.cameras.iter().map(view).collect()
            })
            .collect();
        Self::gather(samples.iter().map(Vec::as_slice), size, pad)
    }

    /// Pixels of one view that count, `[H, W]`; `at` is sample · V + view.
    ///
    /// # Panics
    /// When there is no such view.
    pub fn counted_pixels(&self, at: usize) -> &[bool] {
        let plane = self.height * self.width;
        &self.pixel_mask[at * plane..][..plane]
    }

    /// Whether a view that counts has pixels that do not.
    pub fn has_ignored_pixels(&self) -> bool {
        let views = self.mask.iter().enumerate().filter(|(_, present)| **present);
        views.into_iter().any(|(at, _)| self.counted_pixels(at).contains(&false))
    }

    fn gather<'a>(
        samples: impl ExactSizeIterator<Item = &'a [SampleView]> + Clone,
        size: ImageSize,
        pad: PadViews,
    ) -> Result<Self, DataError> {
        let largest = samples.clone().map(<[_]>::len).max().unwrap_or(0);
        let views = match pad {
            PadViews::Largest => largest,
            PadViews::To(views) if largest <= views => views,
            PadViews::To(views) => {
                return Err(DataError::Config(format!("a frame with {largest} views cannot be padded to {views}")));
            }
        };
        let mut arrays = Self::padding(samples.len(), views, size);
        for (b, sample) in samples.enumerate() {
            for (v, view) in sample.iter().enumerate() {
                arrays.put(b * views + v, view);
            }
        }
        Ok(arrays)
    }

    /// Writes one view; a view without a picture stays padding.
    fn put(&mut self, at: usize, view: &SampleView) {
        let Some(image) = &view.image else { return };
        fn write<const N: usize>(out: &mut [f32], at: usize, rows: &[[f64; N]]) {
            let flat = rows.as_flattened();
            for (slot, value) in out[at * flat.len()..][..flat.len()].iter_mut().zip(flat) {
                *slot = *value as f32;
            }
        }
        self.mask[at] = true;
        self.images[at * image.len()..][..image.len()].copy_from_slice(image);
        let plane = self.height * self.width;
        let pixels = &mut self.pixel_mask[at * plane..][..plane];
        match &view.pixel_mask {
            Some(mask) => pixels.copy_from_slice(mask),
            None => pixels.fill(true),
        }
        write(&mut self.k, at, &view.k.transpose().to_cols_array_2d());
        write(&mut self.ego_from_cam, at, &view.ego_from_cam.to_rows());
        write(&mut self.img_from_raw, at, &view.edit.to_rows());
        write(&mut self.img_from_ego, at, &view.img_from_ego());
        write(&mut self.ego_from_img, at, &view.ego_from_img());
    }
}

/// Pads and joins samples.
///
/// # Errors
/// [`DataError::Config`] for no samples, samples of different picture sizes, or a frame with more views than [`PadViews::To`] allows.
pub fn assemble(samples: Vec<Sample>, pad: PadViews) -> Result<SceneBatch, DataError> {
    let mut sizes = samples
        .iter()
        .flat_map(|s| s.input.iter().chain(&s.target))
        .map(|v| ImageSize { height: v.edit.height, width: v.edit.width });
    let Some(size) = sizes.next() else {
        return Err(DataError::Config("a batch needs at least one sample with a camera".into()));
    };
    if let Some(other) = sizes.find(|s| *s != size) {
        return Err(DataError::Config(format!("pictures of {size:?} and {other:?} cannot form one batch")));
    }
    let input = ViewArrays::gather(samples.iter().map(|s| s.input.as_slice()), size, pad)?;
    let target = ViewArrays::gather(samples.iter().map(|s| s.target.as_slice()), size, pad)?;
    let channels = samples.iter().map(|s| s.target.iter().map(|v| v.channel.clone()).collect()).collect();
    Ok(SceneBatch {
        timestamps_ns: samples.iter().map(|s| s.timestamp_ns).collect(),
        channels,
        input,
        target,
        texts: samples.iter().map(|s| s.text.clone()).collect(),
        clips: None,
        ids: samples.into_iter().map(|s| s.id).collect(),
    })
}

/// Pads and joins the frames of clips, `frames` samples for each clip, clip after clip.
///
/// # Errors
/// As [`assemble`]; [`DataError::Config`] for clips of no frames and for samples that do not fill the last clip.
pub fn assemble_clips(samples: Vec<Sample>, frames: usize, pad: PadViews) -> Result<SceneBatch, DataError> {
    if frames == 0 || !samples.len().is_multiple_of(frames) {
        return Err(DataError::Config(format!("{} frames cannot form clips of {frames} frames", samples.len())));
    }
    let clips = Some(ClipArrays::of(&samples, frames));
    Ok(SceneBatch { clips, ..assemble(samples, pad)? })
}

/// What other cameras on the cars of these frames see: the truth for novel views, one rig per frame.
///
/// # Errors
/// [`DataError::Unsupported`] for a frame whose world cannot be rendered, and [`DataError::Config`] for unusable cameras.
///
/// # Panics
/// When the numbers of frames and rigs differ.
pub fn novel_targets(
    frames: &[SceneFrame],
    rigs: &[CameraRig],
    size: ImageSize,
    pad: PadViews,
) -> Result<ViewArrays, DataError> {
    assert_eq!(frames.len(), rigs.len(), "one rig per frame");
    let options = SampleOptions { size, pose_mode: PoseMode::Static };
    let load = |(frame, rig): (&SceneFrame, &CameraRig)| {
        let moved = rerig(frame, rig)?;
        if moved.views.iter().any(|view| view.image.is_none()) {
            let dataset = frame.id.dataset.clone();
            return Err(DataError::Unsupported { dataset, what: "pictures from cameras that were not there" });
        }
        Ok(Sample::load(&moved, &options)?.target)
    };
    let samples = frames.iter().zip(rigs).map(load).collect::<Result<Vec<_>, DataError>>()?;
    ViewArrays::gather(samples.iter().map(Vec::as_slice), size, pad)
}
