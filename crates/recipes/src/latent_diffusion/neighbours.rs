//! Which views of a batch are neighbours, from their cameras as the network sees them.

use data::{SceneBatch, ViewArrays};
use geometry::glam::{DMat3, DMat4};
use geometry::{CameraRig, Intrinsics, Lens, RigCamera, Rigid};
use stable_diffusion::Adjacency;

/// Neighbours of every view, sample by sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Neighbours(Vec<Vec<Vec<usize>>>);

impl Neighbours {
    /// Cameras that see a common direction are neighbours; rigs without a view to the rear are open chains, and views without a
    /// camera have no neighbours.
    ///
    /// # Errors
    /// Unusable camera matrices.
    pub fn of(batch: &SceneBatch) -> anyhow::Result<Self> {
        let views = &batch.target;
        Ok(Self((0..views.batch).map(|sample| of_sample(views, sample)).collect::<anyhow::Result<_>>()?))
    }

    /// The same rigs `times` times, one repetition after the other, as the network takes them.
    ///
    /// # Errors
    /// Never for neighbours made by [`Neighbours::of`].
    pub fn adjacency(&self, times: usize) -> anyhow::Result<Adjacency> {
        let repeated: Vec<_> = std::iter::repeat_n(&self.0, times).flatten().cloned().collect();
        Ok(Adjacency::new(&repeated)?)
    }
}

fn of_sample(views: &ViewArrays, sample: usize) -> anyhow::Result<Vec<Vec<usize>>> {
    let first = sample * views.views;
    let present: Vec<usize> = (0..views.views).filter(|view| views.mask[first + view]).collect();
    let cameras = present.iter().map(|view| camera(views, first + view)).collect();
    let adjacency = CameraRig { cameras }.adjacency()?;
    let mut lists = vec![Vec::new(); views.views];
    for (at, view) in present.iter().enumerate() {
        let mut list: Vec<usize> = [adjacency.left[at], adjacency.right[at]].into_iter().flatten().collect();
        // Two views that meet on both sides are one neighbour, not two.
        list.dedup();
        lists[*view] = list.into_iter().map(|other| present[other]).collect();
    }
    Ok(lists)
}

/// The pinhole camera of network pixels.
fn camera(views: &ViewArrays, at: usize) -> RigCamera {
    let matrix = |values: &[f32]| {
        let rows: Vec<f64> = values[at * 9..][..9].iter().map(|v| f64::from(*v)).collect();
        DMat3::from_cols_slice(&rows).transpose()
    };
    let k = matrix(&views.img_from_raw) * matrix(&views.k);
    let pose: Vec<f64> = views.ego_from_cam[at * 16..][..16].iter().map(|v| f64::from(*v)).collect();
    let (width, height) = (views.width as u32, views.height as u32);
    RigCamera {
        channel: at.to_string(),
        intrinsics: Intrinsics { fx: k.x_axis.x, fy: k.y_axis.y, cx: k.z_axis.x, cy: k.z_axis.y, width, height },
        lens: Lens::Pinhole,
        ego_from_cam: Rigid::from_mat4(&DMat4::from_cols_slice(&pose).transpose()),
    }
}
