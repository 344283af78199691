//! Occupancy labels against the golden numbers, across the published formats, and written back.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use data::npz::{Dtype, Want, npz_bytes, read_npy};
use data::occupancy::{
    OCC3D_GRID, Occ3d, Occ3dWaymo, OccupancyConfig, WaymoVoxels, read_occ3d, read_occ3d_waymo, read_open_occupancy,
    read_surround_occ, write_occ3d,
};
use data::{DataError, OccupancyGrid, OccupancyLabels};
use geometry::Rigid;
use geometry::glam::DVec3;
use serde_json::Value;

fn folder(inside: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_DATA") else {
        eprintln!("did not run: RIGSCAPE_DATA is not set");
        return None;
    };
    let path = Path::new(&root).join(inside);
    assert!(path.exists(), "RIGSCAPE_DATA is set, but {} does not exist", path.display());
    Some(path)
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    let list: Vec<f64> = value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect();
    list.try_into().unwrap()
}

fn counts(grid: &OccupancyGrid) -> BTreeMap<String, u64> {
    let mut counts = BTreeMap::new();
    grid.labels.iter().for_each(|label| *counts.entry(label.to_string()).or_default() += 1);
    counts
}

fn golden_counts(golden: &Value) -> BTreeMap<String, u64> {
    golden.as_object().unwrap().iter().map(|(label, count)| (label.clone(), count.as_u64().unwrap())).collect()
}

fn ones(mask: &Option<Vec<bool>>) -> usize {
    mask.as_ref().unwrap().iter().filter(|seen| **seen).count()
}

fn real_sample() -> Option<OccupancyGrid> {
    let root = folder("occ3d/Occpancy3D-nuScenes-V1.0/mini")?;
    Some(Occ3d::open(&root, true).unwrap().read("scene-1077", "29796060110c4163b07f06eff4af0753").unwrap())
}

#[test]
fn the_real_labels_equal_the_golden_numbers() {
    let (Some(grid), Some(golden)) = (real_sample(), folder("golden/occupancy.json")) else { return };
    let golden = &json(&golden)["occ3d"];
    assert_eq!(counts(&grid), golden_counts(&golden["counts"]));
    assert_eq!(ones(&grid.lidar_mask), golden["mask_lidar"].as_u64().unwrap() as usize);
    assert_eq!(ones(&grid.camera_mask), golden["mask_camera"].as_u64().unwrap() as usize);
    let probes = golden["probes"].as_array().unwrap();
    assert!(probes.len() > 40);
    for probe in probes {
        let [x, y, z] = numbers::<3>(&probe["index"]).map(|at| at as usize);
        let center = DVec3::from_array(numbers(&probe["center_ego_m"]));
        assert!(grid.center_in_ego([z, y, x]).abs_diff_eq(center, 1e-9), "{probe}");
        assert_eq!(grid.cell_at(center), Some([z, y, x]), "{probe}");
        assert_eq!(grid.label_at(center).map(u64::from), probe["label"].as_u64(), "{probe}");
    }
    let driveable = OccupancyLabels::NuScenes.class_names().iter().position(|name| *name == "driveable_surface");
    let driveable = driveable.unwrap() as u8;
    let slices: Vec<usize> =
        (0..16).filter(|z| grid.labels[z * 40_000..(z + 1) * 40_000].contains(&driveable)).collect();
    assert_eq!(slices, [0]);
    let seen: Vec<&u8> = grid.labels.iter().zip(grid.counted()).filter(|seen| seen.1).map(|seen| seen.0).collect();
    assert_eq!(seen.len(), 43_355);
    let free = |labels: &[&u8]| labels.iter().filter(|label| ***label == 17).count() as f64 / labels.len() as f64;
    let all: Vec<&u8> = grid.labels.iter().collect();
    assert!(free(&all) - free(&seen) > 0.05, "masks change the share of free cells");
}

#[test]
fn written_labels_are_read_back_and_are_the_same_every_time() {
    let Some(mut grid) = real_sample() else { return };
    let dir = tempfile::tempdir().unwrap();
    let path = write_occ3d(dir.path(), "scene-1077", "token", &grid).unwrap();
    assert_eq!(Occ3d::open(dir.path(), true).unwrap().read("scene-1077", "token").unwrap(), grid);
    assert_eq!(Occ3d::open(dir.path().join("gts"), true).unwrap().read("scene-1077", "token").unwrap(), grid);
    let again = write_occ3d(dir.path(), "scene-1077", "other", &grid).unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(again).unwrap());
    assert!(matches!(write_occ3d(dir.path(), "scene-1077", "token", &grid), Err(DataError::Io { .. })));
    assert!(matches!(write_occ3d(dir.path(), "..", "token", &grid), Err(DataError::UnsafePath { .. })));
    let absent = Occ3d::open(dir.path(), true).unwrap().read("scene-1077", "nowhere").unwrap_err();
    assert!(matches!(absent, DataError::Missing { .. }) && absent.to_string().ends_with("labels.npz"), "{absent}");
    let hostile = Occ3d::open(dir.path(), true).unwrap().read("../../..", "etc").unwrap_err();
    assert!(matches!(hostile, DataError::UnsafePath { .. }));
    grid.labels[5] = OccupancyGrid::IGNORED;
    assert!(write_occ3d(dir.path(), "s", "ignored", &grid).is_err());
    grid.labels[5] = 17;
    grid.ego_from_grid = Rigid::from_yaw(0.1, DVec3::ZERO);
    assert!(write_occ3d(dir.path(), "s", "turned", &grid).is_err());
}

/// The scene of the derived fixtures in its four forms, with the lidar's mounting.
fn derived() -> Option<(PathBuf, Rigid)> {
    let root = folder("")?;
    let row = json(&root.join("surroundocc_source/calib/lidar_calibrated_sensor0.json"));
    Some((root, Rigid::from_wxyz(numbers(&row["rotation"]), numbers(&row["translation"])).unwrap()))
}

const OPEN: &str = "occ_derived/openoccupancy/scene_derived/occupancy/88469429c4a74956b075812ed9440c6f.npy";
const SURROUND: &str = "occ_derived/surroundocc/samples/derived__LIDAR_TOP__1531884156948944.pcd.bin.npy";
const DENSE: &str = "occ_derived/occ3d_format/gts/derived/88469429c4a74956b075812ed9440c6f/labels.npz";

#[test]
fn lists_of_cells_equal_the_golden_numbers() {
    let Some((root, ego_from_lidar)) = derived() else { return };
    let golden = json(&root.join("golden/occupancy.json"));
    let sets = [
        (
            "openoccupancy",
            OPEN,
            "row_z_y_x_label",
            read_open_occupancy(&root.join(OPEN).into(), ego_from_lidar),
            Dtype::U16,
        ),
        ("surroundocc", SURROUND, "row", read_surround_occ(&root.join(SURROUND).into(), ego_from_lidar), Dtype::I64),
    ];
    for (name, file, first, grid, dtype) in sets {
        let (grid, golden) = (grid.unwrap(), &golden[name]);
        let mut got = counts(&grid);
        let free = got.remove("17").unwrap();
        assert_eq!(got, golden_counts(&golden["labels"]), "{name}");
        assert_eq!(grid.labels.len() as u64 - free, golden["rows"].as_u64().unwrap(), "{name}");
        let rows = read_npy(&root.join(file).into(), &Want { dtypes: &[dtype], shape: &[None, Some(4)] }).unwrap();
        let row = numbers::<4>(&golden["first_row"][first]).map(|value| value as i64);
        assert_eq!(rows.to_i64().unwrap()[..4], row);
        let center = DVec3::from_array(numbers(&golden["first_row"]["center_lidar_m"]));
        let cell = grid.cell_at(ego_from_lidar * center).unwrap();
        assert!(grid.grid.center(cell[0], cell[1], cell[2]).abs_diff_eq(center, 1e-9), "{name}");
        assert_eq!(grid.label(cell).map(i64::from), Some(row[3]), "{name}");
    }
}

/// Share of the occupied cells of one set, inside the other's grid, that have an equal label within one cell of it.
fn agreement(from: &OccupancyGrid, to: &OccupancyGrid) -> f64 {
    let [nz, ny, nx] = from.grid.cells;
    let (mut equal, mut all) = (0, 0);
    for at in 0..nz * ny * nx {
        let cell = [at / (ny * nx), at / nx % ny, at % nx];
        let label = from.label(cell).unwrap();
        let center = from.center_in_ego(cell);
        if label == 17 || label == OccupancyGrid::IGNORED || to.cell_at(center).is_none() {
            continue;
        }
        let step = to.grid.cell_size();
        let near = |d: i32| DVec3::new(f64::from(d % 3 - 1), f64::from(d / 3 % 3 - 1), f64::from(d / 9 - 1)) * step;
        all += 1;
        equal += usize::from((0..27).any(|d| to.label_at(center + near(d)) == Some(label)));
    }
    assert!(all > 1000);
    f64::from(equal as u32) / f64::from(all as u32)
}

#[test]
fn lidar_grids_lie_in_the_ego_frame_as_the_dense_labels_do() {
    let Some((root, ego_from_lidar)) = derived() else { return };
    let dense = read_occ3d(&root.join(DENSE).into(), true).unwrap();
    let open = read_open_occupancy(&root.join(OPEN).into(), ego_from_lidar).unwrap();
    let surround = read_surround_occ(&root.join(SURROUND).into(), ego_from_lidar).unwrap();
    for (name, grid) in [("openoccupancy", &open), ("surroundocc", &surround)] {
        let right = agreement(grid, &dense);
        let wrong = agreement(&OccupancyGrid { ego_from_grid: Rigid::IDENTITY, ..grid.clone() }, &dense);
        eprintln!("{name}: {right:.4} of the cells agree, {wrong:.4} without the mounting");
        assert!(right > 0.97, "{name}: {right}");
        assert!(wrong < 0.75, "{name}: {wrong}");
    }
    // The lidar looks to the car's right with x and ahead with y.
    let ahead = open.cell_at(DVec3::new(20.0, 0.0, 1.0)).unwrap();
    let [_, y, x] = ahead;
    assert!(y > 256 + 80 && x.abs_diff(256) < 10, "{ahead:?}");
}

#[test]
fn label_zero_of_lists_is_ignored_and_bad_rows_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let read = |rows: &[[i64; 4]]| {
        let bytes: Vec<u8> = rows.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
        let path = dir.path().join("rows.npy");
        std::fs::write(&path, data::npz::npy_bytes(Dtype::I64, &[rows.len(), 4], &bytes).unwrap()).unwrap();
        read_surround_occ(&path.into(), Rigid::IDENTITY)
    };
    let grid = read(&[[0, 1, 2, 0], [199, 199, 15, 16]]).unwrap();
    assert_eq!((grid.label([2, 1, 0]), grid.label([15, 199, 199])), (Some(255), Some(16)));
    assert_eq!(grid.counted().iter().filter(|counted| !**counted).count(), 1);
    assert!(read(&[]).unwrap().labels.iter().all(|label| *label == grid.free()));
    for (row, word) in
        [([0, -1, 0, 4], "outside"), ([0, 0, 16, 4], "outside"), ([0, 0, 0, 17], "17"), ([0, 0, 0, -1], "-1")]
    {
        let error = read(&[[0, 0, 0, 4], row]).unwrap_err();
        let text = error.to_string();
        assert!(matches!(error, DataError::Format { .. }) && text.contains("row 1") && text.contains(word), "{text}");
    }
}

#[test]
fn waymo_labels_keep_their_own_free_label_and_need_to_be_in_view() {
    let Some(root) = folder("occ3d_waymo_made/validation") else { return };
    let set = Occ3dWaymo::open(&root, WaymoVoxels::Coarse).unwrap();
    let grid = set.read(0, 0).unwrap();
    // Counted in the file by another tool.
    let want = [
        (0, 28_749),
        (1, 2125),
        (2, 16),
        (3, 12),
        (4, 32),
        (7, 2),
        (10, 106_517),
        (13, 4340),
        (14, 1745),
        (23, 496_462),
    ];
    assert_eq!(counts(&grid), want.map(|(label, count)| (label.to_string(), count)).into());
    assert_eq!((ones(&grid.lidar_mask), ones(&grid.camera_mask)), (206_119, 121_764));
    assert_eq!(grid.free(), 23);
    // Element 289431 of the file: x 90, y 89, z 7.
    assert_eq!(grid.label([7, 89, 90]), Some(1));
    assert!(matches!(set.read(0, 1), Err(DataError::Missing { .. })));
    assert!(matches!(Occ3dWaymo::open(&root, WaymoVoxels::Fine).unwrap().read(0, 0), Err(DataError::Missing { .. })));
    let dir = tempfile::tempdir().unwrap();
    let shape = [200, 200, 16];
    let (labels, all) = (vec![23u8; 640_000], vec![2u8; 640_000]);
    let mut in_view = vec![1u8; 640_000];
    in_view[(3 * 200 + 5) * 16 + 7] = 0;
    let bytes = npz_bytes(&[
        ("voxel_label", Dtype::U8, &shape, &labels),
        ("origin_voxel_state", Dtype::U8, &shape, &all),
        ("final_voxel_state", Dtype::U8, &shape, &all),
        ("infov", Dtype::Bool, &shape, &in_view),
    ]);
    let path = dir.path().join("made.npz");
    std::fs::write(&path, bytes.unwrap()).unwrap();
    let made = read_occ3d_waymo(&path.clone().into(), WaymoVoxels::Coarse).unwrap();
    assert_eq!((ones(&made.lidar_mask), ones(&made.camera_mask)), (640_000, 639_999));
    assert!(!made.camera_mask.as_ref().unwrap()[made.index([7, 5, 3])]);
    assert!(matches!(read_occ3d_waymo(&path.into(), WaymoVoxels::Fine), Err(DataError::Array { .. })));
}

#[test]
fn configs_are_strict() {
    let parse = |text: &str| toml::from_str::<OccupancyConfig>(text);
    assert!(parse("kind = \"open_occupancy\"\nroot = \"o\"\nmasks = false\nbetween = \"nearest\"").is_ok());
    assert!(parse("kind = \"occ3d\"").is_err());
    assert!(parse("kind = \"occ3d\"\nroot = \"o\"\nfree = 17").is_err());
    assert_eq!(OCC3D_GRID.checked().unwrap().len(), 640_000);
    assert!((OCC3D_GRID.cell_size() - DVec3::splat(0.4)).length() < 1e-12);
    assert!((WaymoVoxels::Fine.grid().cell_size() - DVec3::new(0.1, 0.1, 0.2)).length() < 1e-12);
}

#[test]
fn the_fine_waymo_grid_is_read_whole() {
    let shape = [1600, 1600, 64];
    let count: usize = shape.iter().product();
    let at = |x: usize, y: usize, z: usize| (x * 1600 + y) * 64 + z;
    let mut labels = vec![23u8; count];
    labels[at(3, 1500, 60)] = 1;
    labels[at(1599, 0, 5)] = 13;
    let mut seen = vec![0u8; count];
    seen[at(3, 1500, 60)] = 1;
    let bytes = npz_bytes(&[
        ("voxel_label", Dtype::U8, &shape, &labels),
        ("origin_voxel_state", Dtype::U8, &shape, &seen),
        ("final_voxel_state", Dtype::U8, &shape, &seen),
        ("infov", Dtype::Bool, &shape, &seen),
    ]);
    drop((labels, seen));
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(dir.path().join("007")).unwrap();
    std::fs::write(dir.path().join("007/042.npz"), bytes.unwrap()).unwrap();
    let grid = Occ3dWaymo::open(dir.path(), WaymoVoxels::Fine).unwrap().read(7, 42).unwrap();
    assert_eq!((grid.grid.cells, grid.grid.x_range, grid.grid.z_range), ([64, 1600, 1600], [-80.0, 80.0], [-5.0, 7.8]));
    assert_eq!(
        (grid.label([60, 1500, 3]), grid.label([5, 0, 1599]), grid.label([5, 1, 1599])),
        (Some(1), Some(13), Some(23))
    );
    assert_eq!(counts(&grid)["23"], count as u64 - 2);
    assert_eq!((ones(&grid.lidar_mask), ones(&grid.camera_mask)), (1, 1));
}
