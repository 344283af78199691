//! A sentence for frames of datasets without text.

use crate::{ObjectBox, ObjectClass};

/// Counts objects by class, most frequent first; animals, signs and the like are left out.
pub(crate) fn of_boxes(boxes: &[ObjectBox]) -> String {
    let mut counts: Vec<(usize, [&str; 2])> = ObjectClass::ALL
        .into_iter()
        .filter_map(|class| Some((boxes.iter().filter(|found| found.class == class).count(), words(class)?)))
        .filter(|(count, _)| *count > 0)
        .collect();
    // Stable: classes that are equally frequent keep their order.
    counts.sort_by_key(|(count, _)| std::cmp::Reverse(*count));
    let parts: Vec<String> =
        counts.iter().map(|(count, [one, many])| format!("{count} {}", if *count == 1 { one } else { many })).collect();
    match parts.split_last() {
        None => "A driving scene".to_owned(),
        Some((last, [])) => format!("A driving scene with {last}"),
        Some((last, others)) => format!("A driving scene with {} and {last}", others.join(", ")),
    }
}

fn words(class: ObjectClass) -> Option<[&'static str; 2]> {
    Some(match class {
        ObjectClass::Car => ["car", "cars"],
        ObjectClass::Truck => ["truck", "trucks"],
        ObjectClass::Bus => ["bus", "buses"],
        ObjectClass::Trailer => ["trailer", "trailers"],
        ObjectClass::ConstructionVehicle => ["construction vehicle", "construction vehicles"],
        ObjectClass::Motorcycle => ["motorcycle", "motorcycles"],
        ObjectClass::Bicycle => ["bicycle", "bicycles"],
        ObjectClass::Pedestrian => ["pedestrian", "pedestrians"],
        ObjectClass::TrafficCone => ["traffic cone", "traffic cones"],
        ObjectClass::Barrier => ["barrier", "barriers"],
        ObjectClass::Sign | ObjectClass::Animal | ObjectClass::Other => return None,
    })
}

#[cfg(test)]
mod tests {
    use geometry::Box3d;
    use geometry::glam::DVec3;

    use super::*;

    #[test]
    fn frequent_classes_come_first() {
        let found = |class| ObjectBox {
            box3d: Box3d { center: DVec3::ZERO, size: DVec3::ONE, yaw: 0.0 },
            class,
            track: String::new(),
            source_class: String::new(),
            velocity: None,
            attributes: Vec::new(),
            points: None,
            visibility: None,
            interpolated: false,
        };
        assert_eq!(of_boxes(&[]), "A driving scene");
        assert_eq!(of_boxes(&[found(ObjectClass::Other)]), "A driving scene");
        assert_eq!(of_boxes(&[found(ObjectClass::Bus)]), "A driving scene with 1 bus");
        let many = [ObjectClass::Bus, ObjectClass::Pedestrian, ObjectClass::Truck, ObjectClass::Pedestrian].map(found);
        assert_eq!(of_boxes(&many), "A driving scene with 2 pedestrians, 1 truck and 1 bus");
    }
}
