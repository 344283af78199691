//! Does a removed box disappear where it stood, and does the rest stay? Equal noise with and without one box; changed pixels are counted
//! where the box projects to, and where the same box would project to at random places.

use data::SampleView;
use data::layout::{Layout, LayoutBox};
use geometry::glam::{DQuat, DVec3};
use geometry::{CameraRig, OrientedBox};
use metrics::EditLocality;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::sample::LatentSampler;
use super::step::Frozen;
use super::{DitExperiment, LatentItem, NoiseKey};

/// A pixel counts as changed when a channel differs by more than this; values in [0, 1].
const CHANGED: f32 = 0.1;
/// Pixels around a projected box that belong to it.
const MARGIN_PX: f64 = 1.0;
/// Smallest projection that is measured, pixels in all views.
const LEAST_PX: usize = 24;
/// Nearest and farthest centre of an edited box, metres.
const DISTANCE_M: [f64; 2] = [4.0, 16.0];
/// Random places per edit.
const PLACES: usize = 16;
/// Attempts to find them.
const ATTEMPTS: usize = 200;

/// What removing boxes did.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EditScores {
    /// Boxes removed, one at a time.
    pub edits: usize,
    /// Share of changed pixels where they stood.
    pub changed_in_box: f64,
    /// Share of changed pixels where boxes of their size at random places would stand.
    pub changed_in_random_boxes: f64,
    /// Of these two shares; `None` where nothing changes at random places.
    pub ratio: Option<f64>,
    /// Mean absolute change inside over outside.
    pub change_inside_over_outside: Option<f64>,
}

/// Pixels of a view.
type Mask = Vec<bool>;

/// Removes the best visible box of the first class from as many layouts as the config asks for; `None` where no layout has one.
pub(super) fn edit_locality(
    (frozen, sampler, experiment): (&Frozen, &LatentSampler, &DitExperiment),
    items: &[LatentItem],
    rig: &CameraRig,
    seed: u64,
) -> anyhow::Result<Option<EditScores>> {
    let projector = Projector::new(frozen, rig);
    let cameras = frozen.vae.cameras(rig)?;
    let mut collected = Collected::default();
    let visible = items.iter().filter_map(|item| Some((item, projector.best_box(&item.layout)?)));
    for (item, (at, masks)) in visible.take(experiment.evaluation.edits) {
        let mut without = item.layout.clone();
        let removed = without.boxes.remove(at);
        let key = NoiseKey { seed, token: item.token(), draw: 0 };
        let latents = sampler.sample(
            &[&item.layout, &without],
            &[key.clone(), key],
            &experiment.preview_sampler(),
            experiment.sampling.guidance,
        )?;
        let painted = |place: usize| frozen.vae.decode(latents.clone().narrow(0, place, 1), &cameras);
        let mut rng = train::stream(seed, &format!("edits/{}", item.token()), 0);
        let places = projector.random_boxes(&removed, &masks, &mut rng);
        collected.add((&painted(0), &painted(1)), &masks, &places);
    }
    Ok(collected.scores())
}

/// Figures of edits so far.
#[derive(Debug, Default)]
struct Collected {
    edits: usize,
    locality: EditLocality,
    inside: Share,
    random: Share,
}

impl Collected {
    fn add(&mut self, (before, after): (&[Vec<f32>], &[Vec<f32>]), masks: &[Mask], places: &[Vec<Mask>]) {
        let changed: Vec<Mask> = before.iter().zip(after).map(|(a, b)| changed_pixels(a, b)).collect();
        for ((before, after), mask) in before.iter().zip(after).zip(masks) {
            self.locality.update(before, after, mask);
        }
        self.inside.add(&changed, masks);
        places.iter().for_each(|place| self.random.add(&changed, place));
        self.edits += 1;
    }

    fn scores(&self) -> Option<EditScores> {
        let (inside, random) = (self.inside.value()?, self.random.value()?);
        Some(EditScores {
            edits: self.edits,
            changed_in_box: inside,
            changed_in_random_boxes: random,
            ratio: (random > 0.0).then_some(inside / random),
            change_inside_over_outside: self.locality.ratio(),
        })
    }
}

/// Changed pixels among those of masks.
#[derive(Debug, Default)]
struct Share {
    changed: usize,
    pixels: usize,
}

impl Share {
    fn add(&mut self, changed: &[Mask], masks: &[Mask]) {
        let inside = changed.iter().flatten().zip(masks.iter().flatten()).filter(|(_, inside)| **inside);
        for (changed, _) in inside {
            self.pixels += 1;
            self.changed += usize::from(*changed);
        }
    }

    fn value(&self) -> Option<f64> {
        (self.pixels > 0).then(|| self.changed as f64 / self.pixels as f64)
    }
}

fn changed_pixels(before: &[f32], after: &[f32]) -> Mask {
    let plane = before.len() / 3;
    let differs = |at: usize| (0..3).any(|c| (before[c * plane + at] - after[c * plane + at]).abs() > CHANGED);
    (0..plane).map(differs).collect()
}

/// Boxes to the pixels of a rig's network pictures.
struct Projector {
    views: Vec<[[f64; 4]; 3]>,
    height: usize,
    width: usize,
    /// Classes in channel order; the first one is edited.
    class: Option<String>,
    half: [f64; 2],
}

impl Projector {
    fn new(frozen: &Frozen, rig: &CameraRig) -> Self {
        let size = frozen.vae.image_size();
        let view = |camera| SampleView::of_camera(camera, size).img_from_ego();
        let grid = &frozen.conditioner.grid;
        Self {
            views: rig.cameras.iter().map(view).collect(),
            height: size.height as usize,
            width: size.width as usize,
            class: frozen.conditioner.classes.names.first().cloned(),
            half: [grid.x_range, grid.y_range].map(|range| range[1].min(-range[0])),
        }
    }

    /// Place of the box of the edited class that covers most pixels, and these.
    fn best_box(&self, layout: &Layout) -> Option<(usize, Vec<Mask>)> {
        let candidates = layout.boxes.iter().enumerate().filter(|(_, found)| {
            let distance = found.shape.center.truncate().length();
            Some(&found.class) == self.class.as_ref() && (DISTANCE_M[0]..DISTANCE_M[1]).contains(&distance)
        });
        let masked = candidates.map(|(at, found)| (at, self.masks(&found.shape)));
        let visible = masked.filter(|(_, masks)| covered(masks) >= LEAST_PX);
        visible.max_by_key(|(_, masks)| covered(masks))
    }

    /// The same box at random places that cameras see and that do not meet its own pixels.
    fn random_boxes(&self, own: &LayoutBox, masks: &[Mask], rng: &mut ChaCha8Rng) -> Vec<Vec<Mask>> {
        let mut found = Vec::new();
        for _ in 0..ATTEMPTS {
            let [x, y] = self.half.map(|half| rng.random_range(-half..half));
            let yaw = rng.random_range(0.0..std::f64::consts::TAU);
            let distance = x.hypot(y);
            let center = DVec3::new(x, y, own.shape.center.z);
            let shape = OrientedBox { center, size: own.shape.size, rotation: DQuat::from_rotation_z(yaw) };
            let place = self.masks(&shape);
            let meets = place.iter().flatten().zip(masks.iter().flatten()).any(|(a, b)| *a && *b);
            if (DISTANCE_M[0]..DISTANCE_M[1]).contains(&distance) && covered(&place) >= LEAST_PX && !meets {
                found.push(place);
            }
            if found.len() == PLACES {
                break;
            }
        }
        found
    }

    /// Pixels of every view inside the rectangle around a box's corners; none where a corner lies behind the camera.
    fn masks(&self, shape: &OrientedBox) -> Vec<Mask> {
        let corners = shape.corners();
        self.views.iter().map(|view| self.mask(view, &corners)).collect()
    }

    fn mask(&self, view: &[[f64; 4]; 3], corners: &[DVec3; 8]) -> Mask {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        let mut behind = false;
        for corner in corners {
            let [u, v, depth] = view.map(|row| row[0] * corner.x + row[1] * corner.y + row[2] * corner.z + row[3]);
            behind |= depth < 0.1;
            for (axis, value) in [u / depth, v / depth].into_iter().enumerate() {
                (low[axis], high[axis]) = (low[axis].min(value), high[axis].max(value));
            }
        }
        let inside = |at: usize| {
            let pixel = [(at % self.width) as f64 + 0.5, (at / self.width) as f64 + 0.5];
            !behind && (0..2).all(|axis| pixel[axis] > low[axis] - MARGIN_PX && pixel[axis] < high[axis] + MARGIN_PX)
        };
        (0..self.height * self.width).map(inside).collect()
    }
}

fn covered(masks: &[Mask]) -> usize {
    masks.iter().flatten().filter(|inside| **inside).count()
}
