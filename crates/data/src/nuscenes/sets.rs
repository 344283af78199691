//! Pictures that belong to one instant.
//!
//! Exposures follow a 20 Hz lidar and frames get lost, so neither position nor nearest time pairs pictures correctly: each stamp is
//! first freed of its camera's typical offset from the samples, then pictures within half a lidar turn form a set.

use std::ops::Range;

use geometry::{CameraRig, Intrinsics, Lens, RigCamera};

use super::config::{FrameChoice, NuScenesConfig};
use super::pictures::{Picture, Pictures, channel};
use super::tables::{Base, Sensor};
use crate::DataError;

/// A camera of a scene's rig.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slot {
    pub channel: u32,
    /// Row of the calibration table.
    pub sensor: u32,
    pub size: (u32, u32),
    /// Median of picture stamp minus sample stamp over the scene's key pictures.
    pub offset_ns: i64,
}

/// The cameras of a scene, clockwise from the front, and its pose rows in time order.
#[derive(Debug)]
pub(super) struct SceneRig {
    pub slots: Vec<Slot>,
    pub pose_rows: Vec<u32>,
}

/// The pictures of one instant.
#[derive(Debug)]
pub(super) struct PictureSet {
    pub scene: u32,
    /// The sample whose key pictures these are.
    pub sample: Option<u32>,
    /// Stamp of the sample, or the median of the pictures' stamps without their offsets.
    pub time_ns: i64,
    /// For each slot of the scene's rig, the picture's row.
    pub pictures: Vec<Option<u32>>,
}

impl PictureSet {
    /// Token of the sample, or the stamp.
    pub fn name(&self, base: &Base) -> String {
        match self.sample {
            Some(sample) => base.samples[sample as usize].token.to_string(),
            None => self.time_ns.to_string(),
        }
    }
}

/// Rigs of all scenes and the sets in frame order, with each scene's range of them.
pub(super) type Grouped = (Vec<SceneRig>, Vec<PictureSet>, Vec<Range<usize>>);

/// Groups all pictures.
pub(super) fn group(config: &NuScenesConfig, base: &Base, pictures: &Pictures) -> Result<Grouped, DataError> {
    let (mut rigs, mut sets, mut ranges) = (Vec::new(), Vec::new(), Vec::new());
    let mut start = 0;
    for scene in 0..base.scenes.len() {
        let of_scene = |row: &&Picture| base.samples[row.sample as usize].scene as usize == scene;
        let count = pictures.rows[start..].iter().take_while(of_scene).count();
        let rows = start..start + count;
        start += count;
        let rig = scene_rig(base, pictures, scene, rows.clone());
        let mut found = scene_sets(config, base, pictures, scene, rows, &rig)?;
        found.retain(|set| set.pictures.iter().any(Option::is_some));
        if config.require_all_views {
            found.retain(|set| set.pictures.iter().all(Option::is_some));
        }
        found.retain(|set| config.exclude.is_empty() || !config.exclude.contains(&set.name(base)));
        found.sort_by_key(|set| set.time_ns);
        ranges.push(sets.len()..sets.len() + found.len());
        sets.append(&mut found);
        rigs.push(rig);
    }
    Ok((rigs, sets, ranges))
}

/// The intrinsics of a picture's camera for its own size.
pub(super) fn intrinsics(base: &Base, sensor: u32, size: (u32, u32)) -> Option<(Intrinsics, geometry::Rigid)> {
    match base.sensors[sensor as usize] {
        Sensor::Camera { ego_from_cam, focal_center: [fx, fy, cx, cy], .. } => {
            Some((Intrinsics { fx, fy, cx, cy, width: size.0, height: size.1 }, ego_from_cam))
        }
        Sensor::Lidar { .. } | Sensor::Unwanted => None,
    }
}

fn scene_rig(base: &Base, pictures: &Pictures, scene: usize, rows: Range<usize>) -> SceneRig {
    let scene_pictures = &pictures.rows[rows];
    let mut slots = Vec::new();
    let mut cameras = Vec::new();
    for of_channel in scene_pictures.chunk_by(|a, b| channel(base, a) == channel(base, b)) {
        let first = of_channel[0];
        let Some((intrinsics, ego_from_cam)) = intrinsics(base, first.sensor, first.size) else { continue };
        let key_rows = of_channel.iter().filter(|row| row.is_key);
        let offsets = key_rows.map(|row| row.time_ns - base.samples[row.sample as usize].time_ns).collect();
        let channel = channel(base, &first);
        let offset_ns = median(offsets).unwrap_or_else(|| {
            let (scene, name) = (&base.scenes[scene].name, &base.channels[channel as usize]);
            tracing::warn!("{scene} has no key picture of {name}; its stamps are used without an offset");
            0
        });
        slots.push(Slot { channel, sensor: first.sensor, size: first.size, offset_ns });
        let channel = base.channels[channel as usize].to_string();
        cameras.push(RigCamera { channel, intrinsics, lens: Lens::Pinhole, ego_from_cam });
    }
    let order = CameraRig { cameras }.clockwise_order();
    let slots = order.into_iter().map(|at| slots[at]).collect();
    let lidar = base.scenes[scene].samples.clone().filter_map(|sample| Some(pictures.lidar[sample].as_ref()?.pose));
    let mut pose_rows: Vec<u32> = scene_pictures.iter().map(|row| row.pose).chain(lidar).collect();
    pose_rows.sort_by_key(|row| (pictures.poses[*row as usize].time_ns, *row));
    pose_rows.dedup_by_key(|row| pictures.poses[*row as usize].time_ns);
    SceneRig { slots, pose_rows }
}

/// The middle value, or the mean of the two middle ones.
fn median(mut values: Vec<i64>) -> Option<i64> {
    values.sort_unstable();
    let middle = values.len() / 2;
    let upper = *values.get(middle)?;
    let odd = values.len() % 2 == 1;
    Some(if odd { upper } else { values[middle - 1] + (upper - values[middle - 1]) / 2 })
}

/// A picture on its way into a set: stamp without offset, slot, row.
type Loose = (i64, usize, u32);

fn scene_sets(
    config: &NuScenesConfig,
    base: &Base,
    pictures: &Pictures,
    scene: usize,
    rows: Range<usize>,
    rig: &SceneRig,
) -> Result<Vec<PictureSet>, DataError> {
    let empty =
        |sample, time_ns| PictureSet { scene: scene as u32, sample, time_ns, pictures: vec![None; rig.slots.len()] };
    let samples = base.scenes[scene].samples.clone();
    let mut sets: Vec<PictureSet> =
        samples.clone().map(|sample| empty(Some(sample as u32), base.samples[sample].time_ns)).collect();
    let mut loose: Vec<Loose> = Vec::new();
    for row in rows {
        let picture = &pictures.rows[row];
        let Some(slot) = rig.slots.iter().position(|slot| slot.channel == channel(base, picture)) else { continue };
        if !picture.is_key {
            loose.push((picture.time_ns - rig.slots[slot].offset_ns, slot, row as u32));
            continue;
        }
        let set = &mut sets[picture.sample as usize - samples.start];
        if set.pictures[slot].replace(row as u32).is_some() {
            let channel = &base.channels[rig.slots[slot].channel as usize];
            let why = format!("two key pictures of {channel} for sample {}", set.name(base));
            return Err(DataError::Json { why, path: base.path("sample_data") });
        }
    }
    if let FrameChoice::AllPictures { pairing_window_ms, .. } = config.frames {
        let window_ns = (pairing_window_ms * 1e6) as i64;
        loose.sort_unstable();
        let loose = fill_key_sets(&mut sets, loose, window_ns);
        let mut open: Vec<Loose> = Vec::new();
        let close = |open: &mut Vec<Loose>, sets: &mut Vec<PictureSet>| {
            let Some(time_ns) = median(open.iter().map(|picture| picture.0).collect()) else { return };
            let mut set = empty(None, time_ns);
            open.drain(..).for_each(|(_, slot, row)| set.pictures[slot] = Some(row));
            sets.push(set);
        };
        for picture in loose {
            let joins = median(open.iter().map(|picture| picture.0).collect()).is_some_and(|center| {
                (picture.0 - center).abs() <= window_ns && open.iter().all(|other| other.1 != picture.1)
            });
            if !joins {
                close(&mut open, &mut sets);
            }
            open.push(picture);
        }
        close(&mut open, &mut sets);
    }
    Ok(sets)
}

/// A sweep of the very lidar turn of a sample takes the place of that sample's missing key picture; the others are returned.
fn fill_key_sets(sets: &mut [PictureSet], loose: Vec<Loose>, window_ns: i64) -> Vec<Loose> {
    let keep = |&(time_ns, slot, row): &Loose| {
        let after = sets.partition_point(|set| set.time_ns < time_ns);
        let near = [after.checked_sub(1), Some(after)].into_iter().flatten().filter(|at| *at < sets.len());
        let nearest = near.min_by_key(|at| (sets[*at].time_ns - time_ns).abs());
        let target = nearest.map(|at| &mut sets[at]).filter(|set| (set.time_ns - time_ns).abs() <= window_ns);
        match target.filter(|set| set.pictures[slot].is_none()) {
            Some(set) => {
                set.pictures[slot] = Some(row);
                false
            }
            None => true,
        }
    };
    let mut keep = keep;
    loose.into_iter().filter(|picture| keep(picture)).collect()
}
