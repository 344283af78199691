//! Conditions against golden numbers on real calibrations and labels, and what no golden case holds.

use std::path::{Path, PathBuf};

use data::conditions::{
    ForegroundMask, LatentRays, MaskConfig, MaskRegion, RaySampling, camera_code, fourier_code, project_box,
};
use data::npz::{Dtype, Npz, Want};
use data::occupancy::OCC3D_GRID;
use data::{OccupancyGrid, OccupancyLabels};
use geometry::glam::{DMat3, DMat4, DVec2, DVec3};
use geometry::{BevGrid, Box3d, Camera, ImageEdit, Intrinsics, Lens, Rigid};
use safetensors::{Dtype as Element, SafeTensors};
use serde_json::Value;

fn golden() -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_GOLDEN") else {
        eprintln!("did not run: RIGSCAPE_GOLDEN is not set");
        return None;
    };
    Some(Path::new(&root).join("conditions"))
}

struct Tensors(Vec<u8>);

impl Tensors {
    fn open(folder: &Path) -> Self {
        Self(std::fs::read(folder.join("io.safetensors")).unwrap())
    }

    fn get(&self, name: &str) -> (Vec<usize>, Vec<f64>) {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let view = file.tensor(name).unwrap_or_else(|error| panic!("{name}: {error}"));
        let values = match view.dtype() {
            Element::F64 => view.data().as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
            Element::F32 => view.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b).into()).collect(),
            Element::I32 => view.data().as_chunks::<4>().0.iter().map(|b| i32::from_le_bytes(*b).into()).collect(),
            other => panic!("{name} is {other:?}"),
        };
        (view.shape().to_vec(), values)
    }

    fn names(&self, start: &str, end: &str) -> Vec<String> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let mut names: Vec<String> = file.names().into_iter().map(ToString::to_string).collect();
        names.retain(|name| name.starts_with(start) && name.ends_with(end));
        names.sort();
        names
    }

    fn matrix(&self, name: &str) -> DMat3 {
        DMat3::from_cols_slice(&self.get(name).1).transpose()
    }

    fn pose(&self, name: &str) -> Rigid {
        Rigid::from_mat4(&DMat4::from_cols_slice(&self.get(name).1).transpose())
    }
}

fn meta(folder: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(folder.join("meta.json")).unwrap()).unwrap()
}

fn camera(k: &DMat3) -> Camera {
    let intrinsics =
        Intrinsics { fx: k.x_axis.x, fy: k.y_axis.y, cx: k.z_axis.x, cy: k.z_axis.y, width: 1600, height: 900 };
    Camera::new(intrinsics, Lens::Pinhole).unwrap()
}

/// 1600x900 to 400x225, the top row cut.
fn photo_edit() -> ImageEdit {
    ImageEdit::identity(1600, 900).resize(400, 225).crop(0, 1, 400, 224)
}

/// An Occ3D file's labels `[x, y, z]` as a grid in ego.
fn occ3d(path: &Path) -> OccupancyGrid {
    let mut file = Npz::parse(std::fs::read(path).unwrap(), path).unwrap();
    let [nz, ny, nx] = OCC3D_GRID.cells;
    let want = Want { dtypes: &[Dtype::U8], shape: &[Some(nx), Some(ny), Some(nz)] };
    let stored = file.array("semantics", &want).unwrap().into_u8().unwrap();
    let at = |cell: usize| {
        let (z, y, x) = (cell / (ny * nx), cell / nx % ny, cell % nx);
        stored[(x * ny + y) * nz + z]
    };
    let labels = (0..nz * ny * nx).map(at).collect();
    grid(OCC3D_GRID, labels)
}

fn grid(grid: BevGrid, labels: Vec<u8>) -> OccupancyGrid {
    let label_set = OccupancyLabels::NuScenes;
    OccupancyGrid { grid, ego_from_grid: Rigid::IDENTITY, label_set, labels, lidar_mask: None, camera_mask: None }
}

fn find(folder: &Path, tail: &str) -> Option<PathBuf> {
    let inside = std::fs::read_dir(folder).ok()?.map(|entry| entry.unwrap().path());
    let (folders, files): (Vec<PathBuf>, Vec<PathBuf>) = inside.partition(|path| path.is_dir());
    let own = files.into_iter().find(|path| path.to_string_lossy().ends_with(tail));
    own.or_else(|| folders.iter().find_map(|folder| find(folder, tail)))
}

#[test]
fn rays_meet_the_golden_labels() {
    let (Some(folder), Some(data)) = (golden(), std::env::var_os("RIGSCAPE_DATA")) else { return };
    let (tensors, meta) = (Tensors::open(&folder), meta(&folder));
    let label_file = meta["ors"]["label_file"].as_str().unwrap();
    let grid =
        occ3d(&find(Path::new(&data), label_file).unwrap_or_else(|| panic!("no {label_file} below RIGSCAPE_DATA")));
    let mut stored = Npz::parse(std::fs::read(folder.join("ors.npz")).unwrap(), &folder).unwrap();
    let cameras = tensors.names("ors/", "/K");
    assert!(!cameras.is_empty());
    for name in cameras.iter().map(|name| name.trim_start_matches("ors/").trim_end_matches("/K")) {
        let pose = tensors.pose(&format!("ors/{name}/T_ego_cam"));
        let camera = camera(&tensors.matrix(&format!("ors/{name}/K")));
        let (shape, directions) = tensors.get(&format!("ors/{name}/ray_direction_centre"));
        let rays = LatentRays::new(&camera, &photo_edit(), &pose, [shape[0], shape[1]]);
        let off = rays
            .directions
            .iter()
            .zip(directions.chunks_exact(3))
            .map(|(got, want)| (got.unwrap() - DVec3::from_slice(want)).length());
        let off = off.fold(0.0, f64::max);
        assert!(off < 1e-12, "{name}: directions off by {off}");

        let found = rays.sample(&grid, &RaySampling::default());
        let foreground: Vec<u8> = (0..=10).collect();
        let parts = [found.clone(), found.only(&foreground), found.without(&foreground)];
        let shape = [Some(shape[0]), Some(shape[1]), Some(found.samples)];
        for (part, kind) in parts.iter().zip(["class", "foreground", "background"]) {
            let want = Want { dtypes: &[Dtype::U8], shape: &shape };
            let want = stored.array(&format!("{name}_centre_{kind}"), &want).unwrap().into_u8().unwrap();
            let differ = part.labels.iter().zip(&want).filter(|(a, b)| a != b).count();
            assert_eq!(differ, 0, "{name} {kind}");
        }
        let want = Want { dtypes: &[Dtype::U16], shape: &shape[..2] };
        let hits = stored.array(&format!("{name}_centre_first_hit"), &want).unwrap().to_f64();
        let none = f64::from(u16::MAX);
        let ours: Vec<f64> = found.first_hits().into_iter().map(|hit| hit.map_or(none, |hit| hit as f64)).collect();
        assert_eq!(ours, hits, "{name}");
    }
}

#[test]
fn foreground_masks_equal_the_golden_ones() {
    let Some(folder) = golden() else { return };
    let (tensors, meta) = (Tensors::open(&folder), meta(&folder));
    for name in tensors.names("fgm/", "/latent_corners") {
        let case = name.trim_end_matches("/latent_corners");
        let corners = tensors.get(&name).1;
        let objects: Vec<Vec<DVec2>> =
            corners.chunks_exact(16).map(|one| one.chunks_exact(2).map(DVec2::from_slice).collect()).collect();
        for (kind, region, at_least_one) in [
            ("rect", MaskRegion::Rect, false),
            ("hull", MaskRegion::Hull, false),
            ("hull_min1", MaskRegion::Hull, true),
        ] {
            // A case stores the variants it was made for.
            if tensors.names(&format!("{case}/{kind}/"), "mask").is_empty() {
                continue;
            }
            let (shape, mask) = tensors.get(&format!("{case}/{kind}/mask"));
            let config = MaskConfig { region, lambda: 1.0, at_least_one };
            let found = ForegroundMask::draw(&objects, [shape[0], shape[1]], &config);
            let areas: Vec<f64> = found.areas.iter().map(|area| *area as f64).collect();
            assert_eq!(areas, tensors.get(&format!("{case}/{kind}/areas")).1, "{case} {kind}");
            let off = found.weights.iter().zip(&mask).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-6, "{case} {kind}: {off}");
            if kind == "hull" {
                let (noise, predicted) =
                    (tensors.get(&format!("{case}/eps")).1, tensors.get(&format!("{case}/pred")).1);
                let squares = noise.iter().zip(&predicted).map(|(a, b)| (a - b).powi(2));
                let weighted: f64 = squares.zip(found.weights.iter().cycle()).map(|(s, w)| s * f64::from(*w)).sum();
                let wanted = meta["fgm"][case.trim_start_matches("fgm/")]["loss_hull"].as_f64().unwrap();
                assert!((weighted / noise.len() as f64 - wanted).abs() < 1e-6 * wanted);
            }
        }
    }
}

#[test]
fn codes_equal_the_golden_ones() {
    let Some(folder) = golden() else { return };
    let tensors = Tensors::open(&folder);
    let close = |name: &str, got: &[f32], want: &[f64]| {
        assert_eq!(got.len(), want.len(), "{name}");
        let off = got.iter().zip(want).map(|(a, b)| (f64::from(*a) - b).abs() / b.abs().max(1.0)).fold(0.0, f64::max);
        assert!(off < 2e-6, "{name}: {off}");
    };
    for name in tensors.names("tokens/", "/fourier_189") {
        let case = name.trim_end_matches("/fourier_189");
        // The golden file keeps its columns in f32.
        let columns = tensors.get(&format!("{case}/columns_3x7")).1;
        let column = |at: usize| [0, 1, 2].map(|row| columns[row * 7 + at] as f32);
        let code: Vec<f32> = (0..7).flat_map(|at| fourier_code(column(at))).collect();
        close(&name, &code, &tensors.get(&name).1);
        let vector = |at: usize| DVec3::from_array(column(at).map(f64::from));
        let k = DMat3::from_cols(vector(0), vector(1), vector(2));
        let turn = DMat3::from_cols(vector(3), vector(4), vector(5));
        let pose = Rigid::from_mat4(&DMat4::from_mat3_translation(turn, vector(6)));
        // A rotation passes through a unit quaternion: its entries keep seven digits.
        let whole = camera_code(&k, &pose);
        let off = whole.iter().zip(&code).map(|(a, b)| f64::from(a - b).abs()).fold(0.0, f64::max);
        assert!(off < 1e-5, "{case}: {off}");
    }
    let corners = tensors.get("tokens/box_corners_ego").1;
    let code: Vec<f32> =
        corners.chunks_exact(3).flat_map(|c| fourier_code([c[0], c[1], c[2]].map(|v| v as f32))).collect();
    close("box corners", &code, &tensors.get("tokens/box_fourier_216").1);
}

#[test]
fn two_cameras_see_a_pole_displaced_by_their_parallax() {
    let shape = BevGrid { x_range: [0.0, 20.0], y_range: [-10.0, 10.0], z_range: [-2.0, 2.0], cells: [4, 100, 100] };
    let mut labels = vec![17; shape.len()];
    // A pole of three cells' width at x 10.1 m, y 0.1 m: rays are 0.4 m apart there.
    (0..4).for_each(|z| (49..52).for_each(|y| labels[(z * 100 + y) * 100 + 50] = 15));
    let grid = grid(shape, labels);
    let intrinsics = Intrinsics { fx: 800.0, fy: 800.0, cx: 800.0, cy: 450.0, width: 1600, height: 900 };
    let camera = Camera::new(intrinsics, Lens::Pinhole).unwrap();
    let forward = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    let column = |y: f64| {
        let pose = Rigid::from_mat4(&DMat4::from_mat3_translation(forward, DVec3::new(0.0, y, 0.0)));
        let rays = LatentRays::new(&camera, &photo_edit(), &pose, [28, 50]);
        let found = rays.sample(&grid, &RaySampling { samples: 320, step_m: 0.05 });
        let hits = found.first_hits();
        let columns: Vec<usize> = (0..50).filter(|at| hits[14 * 50 + at].is_some()).collect();
        columns.iter().sum::<usize>() as f64 / columns.len() as f64
    };
    // Columns are 32 photo pixels: u = 800 - 800 (y_pole - y) / x.
    for y in [-2.0, 0.0, 1.0] {
        let wanted = (800.0 - 800.0 * (0.1 - y) / 10.1) / 32.0 - 0.5;
        assert!((column(y) - wanted).abs() <= 0.6, "{y}: {} {wanted}", column(y));
    }
}

#[test]
fn rays_agree_with_a_slow_walk_in_turned_grids_and_through_fisheyes() {
    let shape = BevGrid { x_range: [-8.0, 8.0], y_range: [-6.0, 6.0], z_range: [-1.0, 3.0], cells: [5, 12, 16] };
    let labels: Vec<u8> = (0..shape.len()).map(|at| if at * 7919 % 5 == 0 { (at % 17) as u8 } else { 17 }).collect();
    let ego_from_grid = Rigid::from_yaw(0.7, DVec3::new(1.0, -2.0, 0.3));
    let grid = OccupancyGrid { ego_from_grid, ..grid(shape, labels) };
    let intrinsics = Intrinsics { fx: 300.0, fy: 300.0, cx: 320.0, cy: 240.0, width: 640, height: 480 };
    let lens = Lens::KannalaBrandt { k: [0.05, -0.01, 0.002, 0.0] };
    let camera = Camera::new(intrinsics, lens).unwrap();
    let pose = Rigid::from_yaw(-1.3, DVec3::new(-0.5, 0.4, 1.1));
    let rays = LatentRays::new(&camera, &ImageEdit::identity(640, 480).resize(64, 48), &pose, [6, 8]);
    let sampling = RaySampling { samples: 50, step_m: 0.37 };
    let found = rays.sample(&grid, &sampling);
    let mut filled = 0;
    for (ray, direction) in found.labels.chunks_exact(50).zip(&rays.directions) {
        for (i, label) in ray.iter().enumerate() {
            let place =
                direction.map(|direction| ego_from_grid.inverse() * (rays.origin + direction * 0.37 * i as f64));
            let cell = place.and_then(|place| shape.cell_of(place));
            let wanted = cell.map_or(17, |[z, y, x]| grid.labels[(z * 12 + y) * 16 + x]);
            assert_eq!(*label, wanted);
            filled += usize::from(wanted != 17);
        }
    }
    assert!(filled > 50, "{filled}");
    let empty = OccupancyGrid { labels: vec![OccupancyGrid::IGNORED; shape.len()], ..grid };
    assert!(rays.sample(&empty, &sampling).labels.iter().all(|label| *label == 17), "unknown is free");
}

#[test]
fn the_smaller_object_wins_and_an_object_over_everything_weighs_one() {
    let square = |low: f64, high: f64| {
        [(low, low), (high, low), (high, high), (low, high)].map(|(x, y)| DVec2::new(x, y)).to_vec()
    };
    let config = MaskConfig::default();
    let draw = |objects: &[Vec<DVec2>]| ForegroundMask::draw(objects, [10, 10], &config);
    let (large, small) = (square(1.0, 9.0), square(4.0, 6.0));
    let one = draw(&[large.clone(), small.clone()]);
    assert_eq!(one.areas, [64, 4]);
    assert_eq!(one.weights, draw(&[small, large]).weights);
    assert_eq!((one.weights[55], one.weights[22], one.weights[0]), (1.96, 1.36, 1.0));
    assert!(draw(&[square(-5.0, 20.0)]).weights.iter().all(|weight| *weight == 1.0));
    let far = vec![DVec2::new(3.6, 7.7), DVec2::new(3.9, 7.9), DVec2::new(3.7, 7.95)];
    let far = draw(&[far]);
    assert_eq!((far.areas[0], far.weights[73]), (1, 1.99));
    assert_eq!(draw(&[vec![], square(20.0, 30.0)]).areas, [0, 0]);
    // A car beside the camera, half of it behind: no wrap-around.
    let forward = [[5.0, -5.0, 0.0, 0.0], [5.0, 0.0, -5.0, 0.0], [1.0, 0.0, 0.0, 0.0]];
    let beside = Box3d { center: DVec3::new(0.0, 3.0, 0.0), size: DVec3::new(6.0, 1.0, 1.5), yaw: 0.0 };
    let weights = draw(&[project_box(&beside, &forward)]).weights;
    assert!(weights.chunks(10).all(|row| row[5..].iter().all(|weight| *weight == 1.0)), "left half only");
    assert!(weights.iter().any(|weight| *weight > 1.0));
}
