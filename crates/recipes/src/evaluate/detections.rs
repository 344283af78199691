//! A detection result file against the annotations of a nuScenes dataset.

use std::collections::BTreeMap;

use anyhow::{Context, bail};
use data::SceneDataset;
use data::nuscenes::{NuScenes, WorldBox};
use metrics::detection::{
    DetectionBox, DetectionClass, DetectionResults, DetectionScore, DetectionTally, Rack, TrueBox, TruePositiveError,
};

/// The benchmark's class of an annotation category; `None` for categories that it does not evaluate.
fn class_of(category: &str) -> Option<DetectionClass> {
    Some(match category {
        "movable_object.barrier" => DetectionClass::Barrier,
        "movable_object.trafficcone" => DetectionClass::TrafficCone,
        "vehicle.bicycle" => DetectionClass::Bicycle,
        "vehicle.bus.bendy" | "vehicle.bus.rigid" => DetectionClass::Bus,
        "vehicle.car" => DetectionClass::Car,
        "vehicle.construction" => DetectionClass::ConstructionVehicle,
        "vehicle.motorcycle" => DetectionClass::Motorcycle,
        "vehicle.trailer" => DetectionClass::Trailer,
        "vehicle.truck" => DetectionClass::Truck,
        "human.pedestrian.adult"
        | "human.pedestrian.child"
        | "human.pedestrian.construction_worker"
        | "human.pedestrian.police_officer" => DetectionClass::Pedestrian,
        _ => return None,
    })
}

/// Not evaluated itself; bicycles inside one are left out.
const RACK: &str = "static_object.bicycle_rack";

/// The detection score of a result file on every frame of a dataset.
///
/// # Errors
/// Samples that only one side has, frames without annotations, more than one attribute on a box, and what the metric refuses.
pub fn detection_score(dataset: &NuScenes, results: DetectionResults) -> anyhow::Result<DetectionScore> {
    let mut found: BTreeMap<String, Vec<(u64, DetectionBox)>> = results.samples.into_iter().collect();
    let mut tally = DetectionTally::default();
    for index in 0..dataset.len() {
        let frame = dataset.frame(index)?;
        let token = frame.id.frame;
        let boxes = dataset.world_boxes(index)?.with_context(|| format!("sample {token} is not annotated"))?;
        let predicted = found.remove(&token);
        let predicted = predicted.with_context(|| {
            format!("the result file has no sample {token}; every sample of the split must be there, be it with no box")
        })?;
        let truth: Vec<TrueBox> =
            boxes.iter().filter_map(|one| true_box(one).transpose()).collect::<anyhow::Result<_>>()?;
        let racks: Vec<Rack> = boxes.iter().filter(|one| one.source_class == RACK).map(rack).collect();
        tally.update(&token, &truth, &predicted, frame.world_from_ego.translation.to_array(), &racks)?;
    }
    if let Some(token) = found.keys().next() {
        bail!("the result file has {} samples that the split has not, for example {token}", found.len());
    }
    Ok(tally.score()?)
}

fn rack(one: &WorldBox) -> Rack {
    let [length, width, height] = one.size.to_array();
    Rack { center: one.world_from_box.translation.to_array(), size: [width, length, height], rotation: rotation(one) }
}

/// w x y z.
fn rotation(one: &WorldBox) -> [f64; 4] {
    let turn = one.world_from_box.rotation;
    [turn.w, turn.x, turn.y, turn.z]
}

fn true_box(one: &WorldBox) -> anyhow::Result<Option<TrueBox>> {
    let Some(class) = class_of(&one.source_class) else { return Ok(None) };
    let attribute = match one.attributes.as_slice() {
        [] => String::new(),
        [only] => only.clone(),
        several => bail!("annotation {} has {} attributes where one is allowed", one.annotation, several.len()),
    };
    let Rack { center, size, rotation } = rack(one);
    let velocity = one.velocity.map_or([f64::NAN; 2], |velocity| [velocity.x, velocity.y]);
    let found = DetectionBox { class, center, size, rotation, velocity, attribute, score: -1.0 };
    let points = u64::from(one.lidar_points.unwrap_or(0)) + u64::from(one.radar_points.unwrap_or(0));
    Ok(Some(TrueBox { found, points }))
}

/// The score as a table.
pub fn detection_markdown(score: &DetectionScore) -> String {
    let mut lines = vec![
        format!(
            "NDS {:.4}, mAP {:.4} (detection_cvpr_2019, {} samples)",
            score.nds, score.mean_average_precision, score.samples
        ),
        format!(
            "true boxes: {} given, {} evaluated; predictions: {} given, {} evaluated",
            score.boxes_given[0], score.boxes_evaluated[0], score.boxes_given[1], score.boxes_evaluated[1]
        ),
        String::new(),
        "| class | AP | ATE m | ASE | AOE rad | AVE m/s | AAE |\n|---|---|---|---|---|---|---|".to_owned(),
    ];
    let row = |name: &str, precision: f64, errors: [Option<f64>; 5]| {
        let errors = errors.map(|error| error.map_or("-".to_owned(), |error| format!("{error:.4}")));
        format!("| {name} | {precision:.4} | {} |", errors.join(" | "))
    };
    for class in &score.classes {
        lines.push(row(class.class.name(), class.mean_average_precision(), class.errors));
    }
    lines.push(row(
        "mean",
        score.mean_average_precision,
        TruePositiveError::ALL.map(|error| Some(score.errors[error as usize])),
    ));
    lines.join("\n")
}
