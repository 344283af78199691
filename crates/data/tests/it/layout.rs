//! Rasterised layouts against the golden occupancy, and layouts of frames.

use std::path::{Path, PathBuf};

use data::layout::{Layout, LayoutBox, LayoutClasses, Rasterise};
use data::{Procedural, ProceduralConfig, SceneDataset};
use geometry::glam::{DMat4, DVec3};
use geometry::{BevGrid, OrientedBox, Rigid};
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

fn golden() -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_GOLDEN") else {
        eprintln!("did not run: RIGSCAPE_GOLDEN is not set");
        return None;
    };
    let path = Path::new(&root).join("conditions");
    assert!(path.exists(), "RIGSCAPE_GOLDEN is set, but {} does not exist", path.display());
    Some(path)
}

fn numbers(file: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    let view = file.tensor(name).unwrap_or_else(|error| panic!("{name}: {error}"));
    match view.dtype() {
        Dtype::F64 => view.data().chunks_exact(8).map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap())).collect(),
        Dtype::I32 => {
            view.data().chunks_exact(4).map(|bytes| i32::from_le_bytes(bytes.try_into().unwrap()).into()).collect()
        }
        other => panic!("{name} is {other:?}"),
    }
}

fn grid_of(case: &Value) -> BevGrid {
    let cells: Vec<usize> =
        case["grid_DHW"].as_array().unwrap().iter().map(|cells| cells.as_u64().unwrap() as usize).collect();
    let range: Vec<f64> = case["pc"].as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect();
    BevGrid {
        x_range: [range[0], range[3]],
        y_range: [range[1], range[4]],
        z_range: [range[2], range[5]],
        cells: cells.try_into().unwrap(),
    }
}

fn boxes_of(file: &SafeTensors<'_>, case: &str) -> Vec<LayoutBox> {
    let sizes = numbers(file, &format!("occupancy/{case}/lwh"));
    let poses = numbers(file, &format!("occupancy/{case}/T_ego_box"));
    let classes = numbers(file, &format!("occupancy/{case}/class"));
    let shape = |pose: &[f64], size: &[f64]| {
        let ego_from_box = Rigid::from_mat4(&DMat4::from_cols_slice(pose).transpose());
        let (center, rotation) = (ego_from_box.translation, ego_from_box.rotation);
        OrientedBox { center, size: DVec3::from_slice(size), rotation }
    };
    let shapes = poses.chunks_exact(16).zip(sizes.chunks_exact(3)).map(|(pose, size)| shape(pose, size));
    shapes
        .zip(classes)
        .enumerate()
        .map(|(at, (shape, class))| LayoutBox::new(format!("box-{at}"), format!("class-{class}"), shape))
        .collect()
}

fn marked(occupancy: &[f32]) -> Vec<f64> {
    occupancy.iter().enumerate().filter(|(_, value)| **value != 0.0).map(|(at, _)| at as f64).collect()
}

#[test]
fn occupancy_equals_the_golden_bit_for_bit() {
    let Some(folder) = golden() else { return };
    let meta: Value = serde_json::from_slice(&std::fs::read(folder.join("meta.json")).unwrap()).unwrap();
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let cases = meta["occupancy"].as_object().unwrap();
    assert!(!cases.is_empty());
    for (name, case) in cases {
        let grid = grid_of(case);
        let count = case["classes"].as_u64().unwrap();
        let classes = LayoutClasses { names: (0..count).map(|class| format!("class-{class}")).collect() };
        let layout = Layout { boxes: boxes_of(&file, name) };
        let occupancy = layout.occupancy(&grid, &classes, Rasterise::Centres).unwrap();
        assert_eq!(occupancy.len(), classes.len() * grid.len());
        assert_eq!(marked(&occupancy), numbers(&file, &format!("occupancy/{name}/flat_index")), "{name}");

        let alone = numbers(&file, &format!("occupancy/{name}/voxels_per_box"));
        for (found, cells) in layout.boxes.iter().zip(alone) {
            let one = Layout { boxes: vec![found.clone()] };
            let count = |rule| marked(&one.occupancy(&grid, &classes, rule).unwrap()).len() as f64;
            assert_eq!(count(Rasterise::Centres), cells, "{name} {}", found.id);
            let kept = if grid.cell_of(found.shape.center).is_some() { cells.max(1.0) } else { cells };
            assert_eq!(count(Rasterise::CentresOrNearest), kept, "{name} {}", found.id);
        }
    }
}

#[test]
fn a_frame_gives_numbered_boxes_from_near_to_far() {
    let dataset = Procedural::open(&ProceduralConfig { scenes: 1, ..ProceduralConfig::default() }).unwrap();
    let frame = dataset.frame(3).unwrap();
    let classes = LayoutClasses::nuscenes();
    let layout = Layout::of_frame(&frame, &classes);
    let boxes = frame.boxes.as_ref().unwrap();
    assert_eq!(layout.boxes.len(), boxes.iter().filter(|found| classes.name_of(found).is_some()).count());
    assert!(layout.boxes.len() > 5);
    layout.check().unwrap();
    assert!(layout.boxes.iter().any(|found| found.id == "car-1"));
    let distances: Vec<f64> = layout.boxes.iter().map(|found| found.shape.center.length()).collect();
    assert!(distances.is_sorted());
    for found in &layout.boxes {
        let same = boxes.iter().find(|same| Some(&same.track) == found.track.as_ref()).unwrap();
        assert_eq!(found.shape, same.box3d.into());
    }
    let unannotated = data::SceneFrame { boxes: None, ..frame };
    assert_eq!(Layout::of_frame(&unannotated, &classes), Layout::default());
}
