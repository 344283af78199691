//! Occ3D-Waymo labels beside both releases: numbered by segment and frame.

use data::waymo::{Waymo, WaymoConfig, WaymoOccupancy, WaymoRelease};
use data::{DataError, OccupancyLabels, SceneDataset};

use super::fixture;

#[test]
fn labels_belong_to_the_numbered_segment_and_frame() {
    let (Some(root), Some(labels)) = (fixture("waymo"), fixture("occ3d_waymo_made/validation")) else { return };
    for (release, folder) in [(WaymoRelease::V1, "v1_made"), (WaymoRelease::V2, "v2_made")] {
        let occupancy =
            WaymoOccupancy { root: labels.clone().into(), voxels: Default::default(), scenes: Default::default() };
        let base = WaymoConfig { split: "validation".to_owned(), ..WaymoConfig::new(root.join(folder), release) };
        assert!(matches!(Waymo::open(&base).unwrap().occupancy(0), Err(DataError::Unsupported { .. })));
        let config = WaymoConfig { occupancy: Some(occupancy.clone()), ..base };
        let dataset = Waymo::open(&config).unwrap();
        assert!(dataset.capabilities().occupancy);
        let grid = dataset.occupancy(0).unwrap();
        assert_eq!((grid.label_set, grid.label([7, 89, 90])), (OccupancyLabels::Waymo, Some(1)));
        let error = dataset.occupancy(1).unwrap_err().to_string();
        assert!(error.ends_with("000/001_04.npz"), "{error}");
        // Without its first frame the others keep their numbers, and a segment may be given another.
        let first = dataset.frame(0).unwrap().id;
        let scenes = [(first.scene.clone(), 5)].into();
        let exclude = vec![first.frame];
        let occupancy = Some(WaymoOccupancy { scenes, ..occupancy });
        let moved = Waymo::open(&WaymoConfig { exclude, occupancy, ..config }).unwrap();
        let error = moved.occupancy(0).unwrap_err().to_string();
        assert!(error.ends_with("005/001_04.npz"), "{error}");
    }
}
