//! Rasters of a bird's-eye-view segmenter against the map and the boxes of a dataset.
//!
//! Zhou & Krähenbühl, "Cross-view Transformers for Real-time Map-view Semantic Segmentation", section 5: 200×200 cells of 0.5 m around
//! the car, intersection over union summed over the whole set.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use data::npz::{Dtype, Want, parse_npy};
use data::{LocalMap, MapKind, ObjectBox, ObjectClass, SceneDataset};
use geometry::glam::DVec3;
use metrics::SegmentationIou;
use serde::Serialize;

/// Cells along each side.
pub const CELLS: usize = 200;
/// Side of a cell.
const CELL_M: f64 = 0.5;
/// From the car to each side of the raster.
const HALF_M: f64 = CELL_M * CELLS as f64 / 2.0;

/// Thresholds of `miou/cvt`; the first is that of `miou/t0.5`.
const THRESHOLDS: [f64; 2] = [0.5, 0.4];
/// Boxes of lower visibility are not asked for by `miou/cvt`.
const SEEN: u8 = 2;

/// Classes in the order of a raster's first axis.
const CLASSES: [&str; 2] = ["road", "vehicle"];

/// What a set of rasters comes to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SegmentationScore {
    /// Frames measured.
    pub frames: usize,
    /// One entry per protocol and class.
    pub classes: Vec<ClassScore>,
}

/// One class by one protocol.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassScore {
    /// `miou/t0.5` or `miou/cvt`.
    pub protocol: &'static str,
    /// `road` or `vehicle`.
    pub class: &'static str,
    /// In [0, 1]; `None` where neither side has a cell.
    pub iou: Option<f64>,
}

impl SegmentationScore {
    /// IoU of a class by `miou/t0.5`.
    #[must_use]
    pub fn at_half(&self, class: &str) -> Option<f64> {
        self.classes.iter().find(|one| one.class == class && one.protocol == "miou/t0.5").and_then(|one| one.iou)
    }

    /// The score as a table.
    #[must_use]
    pub fn markdown(&self) -> String {
        let header = format!("BEV segmentation of {} frames, {CELLS}x{CELLS} cells of {CELL_M} m\n\n", self.frames);
        let rows = self.classes.iter().map(|one| {
            let iou = one.iou.map_or("- (no cell on either side)".to_owned(), |iou| format!("{iou:.4}"));
            format!("| {} | {} | {iou} |\n", one.class, one.protocol)
        });
        header + "| class | protocol | IoU |\n|---|---|---|\n" + &rows.collect::<String>()
    }
}

/// Compares `<folder>/<frame>.npy` with every frame of a dataset.
///
/// A raster holds probabilities `[2, 200, 200]` of road (drivable area) and vehicle. Row 0 is ahead, column 0 left; a cell counts for a
/// class when its centre lies in an area or box of it.
///
/// # Errors
/// Frames without map, boxes or raster; rasters of another shape, or with values outside [0, 1].
pub fn segmentation_score(dataset: &dyn SceneDataset, folder: &Path) -> anyhow::Result<SegmentationScore> {
    let [mut road, mut vehicle, mut seen_vehicle] = [0; 3].map(|_| SegmentationIou::new(&THRESHOLDS));
    for index in 0..dataset.len() {
        let frame = dataset.frame(index)?;
        let path = folder.join(format!("{}.npy", frame.id.frame));
        let predicted = read_raster(&path)?;
        let (road_part, vehicle_part) = predicted.split_at(CELLS * CELLS);
        let boxes = frame.boxes.with_context(|| format!("frame {} is not annotated", frame.id.frame))?;
        let vehicles: Vec<&ObjectBox> = boxes.iter().filter(|one| is_vehicle(one.class)).collect();
        road.update(road_part, &drivable(&dataset.local_map(index, HALF_M)?), None);
        vehicle.update(vehicle_part, &covered(&vehicles), None);
        let hidden: Vec<&ObjectBox> =
            vehicles.iter().copied().filter(|one| one.visibility.is_some_and(|level| level < SEEN)).collect();
        let counts: Vec<bool> = covered(&hidden).into_iter().map(|hidden| !hidden).collect();
        seen_vehicle.update(vehicle_part, &covered(&vehicles), Some(&counts));
    }
    ensure!(!dataset.is_empty(), "the dataset has no frame");
    let at_half = |iou: &SegmentationIou| iou.overlaps().next().and_then(|(_, overlap)| overlap.iou());
    let [road_name, vehicle_name] = CLASSES;
    let score = |protocol, class, iou| ClassScore { protocol, class, iou };
    let classes = vec![
        score("miou/t0.5", road_name, at_half(&road)),
        score("miou/t0.5", vehicle_name, at_half(&vehicle)),
        score("miou/cvt", road_name, road.best()),
        score("miou/cvt", vehicle_name, seen_vehicle.best()),
    ];
    Ok(SegmentationScore { frames: dataset.len(), classes })
}

fn read_raster(path: &Path) -> anyhow::Result<Vec<f64>> {
    let bytes = std::fs::read(path).with_context(|| {
        format!("cannot read {}: every frame needs its raster, named after the frame", path.display())
    })?;
    let shape = [Some(CLASSES.len()), Some(CELLS), Some(CELLS)];
    let values = parse_npy(&bytes, path, &Want { dtypes: &[Dtype::F32, Dtype::F64], shape: &shape })?.to_f64();
    if let Some(bad) = values.iter().find(|value| !(0.0..=1.0).contains(*value)) {
        bail!("{bad} is no probability: {}", path.display());
    }
    Ok(values)
}

fn is_vehicle(class: ObjectClass) -> bool {
    use ObjectClass::{Bicycle, Bus, Car, ConstructionVehicle, Motorcycle, Trailer, Truck};
    matches!(class, Car | Truck | Bus | Trailer | ConstructionVehicle | Motorcycle | Bicycle)
}

/// Distance along an axis from the car to the centre of a row or column; both count away from forward and left.
fn ahead(cell: usize) -> f64 {
    HALF_M - (cell as f64 + 0.5) * CELL_M
}

/// Cells whose centres lie in the drivable area.
fn drivable(map: &LocalMap) -> Vec<bool> {
    let mut cells = vec![false; CELLS * CELLS];
    for area in map.areas.iter().filter(|area| area.kind == MapKind::Boundary) {
        let rings: Vec<&[[f64; 2]]> = std::iter::once(&area.outer).chain(&area.holes).map(Vec::as_slice).collect();
        for (row, line) in cells.chunks_exact_mut(CELLS).enumerate() {
            let mut crossings: Vec<f64> = rings.iter().flat_map(|ring| crossings_at(ring, ahead(row))).collect();
            crossings.sort_by(f64::total_cmp);
            for inside in crossings.chunks_exact(2) {
                let within = |column: &usize| (inside[0]..inside[1]).contains(&ahead(*column));
                (0..CELLS).filter(within).for_each(|column| line[column] = true);
            }
        }
    }
    cells
}

/// Where a ring crosses the line of this x: the y of each crossing.
fn crossings_at(ring: &[[f64; 2]], x: f64) -> impl Iterator<Item = f64> {
    let edges = ring.iter().zip(ring.iter().cycle().skip(1));
    edges
        .filter(move |(a, b)| (a[0] > x) != (b[0] > x))
        .map(move |(a, b)| a[1] + (x - a[0]) / (b[0] - a[0]) * (b[1] - a[1]))
}

/// Cells whose centres lie in the footprint of a box.
fn covered(boxes: &[&ObjectBox]) -> Vec<bool> {
    let mut cells = vec![false; CELLS * CELLS];
    for one in boxes {
        let center = one.box3d.center;
        let reach = one.box3d.size.truncate().length() / 2.0;
        let range = |at: f64| {
            let cell = |m: f64| ((HALF_M - m) / CELL_M).clamp(0.0, CELLS as f64) as usize;
            cell(at + reach)..(cell(at - reach) + 1).min(CELLS)
        };
        for row in range(center.x) {
            for column in range(center.y) {
                cells[row * CELLS + column] |= one.box3d.contains(DVec3::new(ahead(row), ahead(column), center.z));
            }
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    use data::npz::npy_bytes;
    use data::{MapArea, ProceduralConfig};
    use geometry::Box3d;

    use super::*;

    fn filled(cells: &[bool]) -> (usize, [usize; 2], [usize; 2]) {
        let places = || (0..cells.len()).filter(|at| cells[*at]).map(|at| (at / CELLS, at % CELLS));
        let range = |of: fn((usize, usize)) -> usize| {
            [places().map(of).min().unwrap_or(0), places().map(of).max().unwrap_or(0)]
        };
        (places().count(), range(|place| place.0), range(|place| place.1))
    }

    #[test]
    fn boxes_and_areas_cover_the_cells_whose_centres_they_hold() {
        let box3d = Box3d { center: DVec3::new(10.0, 5.0, 1.0), size: DVec3::new(4.0, 2.0, 1.5), yaw: 0.0 };
        let one = |box3d| ObjectBox {
            box3d,
            class: ObjectClass::Car,
            track: String::new(),
            source_class: String::new(),
            velocity: None,
            attributes: vec![],
            points: None,
            visibility: None,
            interpolated: false,
        };
        // 10 m ahead are 80 rows from the middle's 100, 5 m to the left 10 columns.
        assert_eq!(filled(&covered(&[&one(box3d)])), (8 * 4, [76, 83], [88, 91]));
        let turned = Box3d { yaw: std::f64::consts::FRAC_PI_2, ..box3d };
        assert_eq!(filled(&covered(&[&one(turned)])), (4 * 8, [78, 81], [86, 93]));
        let corner = Box3d { center: DVec3::new(50.0, -50.0, 0.0), ..box3d };
        assert_eq!(filled(&covered(&[&one(corner)])), (4 * 2, [0, 3], [198, 199]));

        let square = |low: f64, high: f64| vec![[low, low], [high, low], [high, high], [low, high]];
        let area = |kind| MapArea { kind, outer: square(-10.0, 10.0), holes: vec![square(-1.0, 1.0)] };
        let map = LocalMap { lines: vec![], areas: vec![area(MapKind::Boundary), area(MapKind::Carpark)] };
        assert_eq!(filled(&drivable(&map)), (40 * 40 - 4 * 4, [80, 119], [80, 119]));
    }

    fn world() -> std::sync::Arc<dyn SceneDataset> {
        let config: ProceduralConfig = toml::from_str(
            "name = \"world\"\nseed = 3\nscenes = 1\nframes_per_scene = 2\nrig = { preset = \"waymo\" }",
        )
        .unwrap();
        data::open(&data::DatasetConfig::Procedural(config)).unwrap()
    }

    fn write(folder: &Path, name: &str, shape: &[usize], values: impl Iterator<Item = f32>) {
        let bytes: Vec<u8> = values.flat_map(f32::to_le_bytes).collect();
        std::fs::write(folder.join(format!("{name}.npy")), npy_bytes(Dtype::F32, shape, &bytes).unwrap()).unwrap();
    }

    #[test]
    fn the_truth_scores_one_and_every_frame_is_asked_for() {
        let (dataset, folder) = (world(), tempfile::tempdir().unwrap());
        let shape = [2, CELLS, CELLS];
        let score = || segmentation_score(dataset.as_ref(), folder.path());
        for index in 0..dataset.len() {
            let frame = dataset.frame(index).unwrap();
            assert!(score().unwrap_err().to_string().contains(&frame.id.frame));
            let boxes = frame.boxes.unwrap();
            let vehicles: Vec<&ObjectBox> = boxes.iter().filter(|one| is_vehicle(one.class)).collect();
            let truth = [drivable(&dataset.local_map(index, HALF_M).unwrap()), covered(&vehicles)].concat();
            assert!(truth.iter().filter(|cell| **cell).count() > 100);
            write(folder.path(), &frame.id.frame, &shape, truth.iter().map(|cell| if *cell { 0.45 } else { 0.1 }));
        }
        let found = score().unwrap();
        assert_eq!((found.at_half("road"), found.at_half("vehicle"), found.frames), (Some(0.0), Some(0.0), 2));
        assert!(found.classes[2..].iter().all(|one| one.protocol == "miou/cvt" && one.iou == Some(1.0)), "{found:?}");
        let first = dataset.frame(0).unwrap().id.frame;
        write(folder.path(), &first, &shape, std::iter::repeat_n(1.5, 2 * CELLS * CELLS));
        assert!(score().unwrap_err().to_string().contains("1.5 is no probability"));
        write(folder.path(), &first, &[1, CELLS, CELLS], std::iter::repeat_n(0.5, CELLS * CELLS));
        assert!(score().unwrap_err().to_string().contains(&first));
    }
}
