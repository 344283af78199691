//! Tables of classes: which channel of the occupancy a name has.

use serde::{Deserialize, Serialize};

use super::LayoutError;
use crate::{ObjectBox, ObjectClass, taxonomy};

/// The devkit's detection classes in the order of its configuration.
const NUSCENES: [&str; 10] = [
    "car",
    "truck",
    "construction_vehicle",
    "bus",
    "trailer",
    "barrier",
    "motorcycle",
    "bicycle",
    "pedestrian",
    "traffic_cone",
];

/// Names of classes; the position is the channel of the occupancy. Checkpoints store the table, and it is compared by name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LayoutClasses {
    /// In channel order.
    pub names: Vec<String>,
}

impl LayoutClasses {
    /// The ten detection classes of nuScenes.
    pub fn nuscenes() -> Self {
        Self::of(&NUSCENES)
    }

    /// The thirty categories of Argoverse 2.
    pub fn argoverse2() -> Self {
        Self::of(&taxonomy::ARGOVERSE2)
    }

    /// The classes all datasets share, [`ObjectClass::ALL`].
    pub fn shared() -> Self {
        Self::of(&ObjectClass::ALL.map(ObjectClass::name))
    }

    fn of(names: &[&str]) -> Self {
        Self { names: names.iter().map(|name| (*name).to_owned()).collect() }
    }

    /// Number of classes.
    pub fn len(&self) -> usize {
        self.names.len()
    }

    /// True for a table without classes, which is no usable one.
    pub fn is_empty(&self) -> bool {
        self.names.is_empty()
    }

    /// # Errors
    /// [`LayoutError::Classes`] for a table without names, with an empty one or with one twice.
    pub fn check(&self) -> Result<(), LayoutError> {
        let refuse = |why: String| Err(LayoutError::Classes { why });
        if self.is_empty() {
            return refuse("it is empty".to_owned());
        }
        for (at, name) in self.names.iter().enumerate() {
            if name.is_empty() {
                return refuse(format!("name {at} is empty"));
            }
            if self.names.iter().take(at).any(|other| other == name) {
                return refuse(format!("{name} occurs twice"));
            }
        }
        Ok(())
    }

    /// The channel of a name.
    pub fn index(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|known| known == name)
    }

    /// The name in this table of a dataset's box: its own class name if the table has it, else the name of its shared class, else the
    /// Argoverse 2 category nearest to that. `None`: the table has nothing for it.
    pub fn name_of(&self, found: &ObjectBox) -> Option<&str> {
        // The annotation guide and the files name the same sign differently.
        let source = match found.source_class.as_str() {
            "MOBILE_PEDESTRIAN_SIGN" => "MOBILE_PEDESTRIAN_CROSSING_SIGN",
            name => name,
        };
        let candidates = [Some(source), Some(found.class.name()), taxonomy::nearest_argoverse2(found.class)];
        candidates
            .into_iter()
            .flatten()
            .find_map(|name| self.names.iter().find(|known| *known == name))
            .map(String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use geometry::Box3d;
    use geometry::glam::DVec3;

    use super::*;

    fn annotated(source_class: &str, class: ObjectClass) -> ObjectBox {
        ObjectBox {
            box3d: Box3d { center: DVec3::ZERO, size: DVec3::ONE, yaw: 0.0 },
            class,
            track: "track".into(),
            source_class: source_class.into(),
            velocity: None,
            attributes: vec![],
            points: None,
            visibility: None,
            interpolated: false,
        }
    }

    #[test]
    fn the_presets_are_sound_and_known_to_the_taxonomy() {
        let (nuscenes, argoverse2, shared) =
            (LayoutClasses::nuscenes(), LayoutClasses::argoverse2(), LayoutClasses::shared());
        assert_eq!((nuscenes.len(), argoverse2.len(), shared.len()), (10, 30, 13));
        for table in [&nuscenes, &argoverse2, &shared] {
            table.check().unwrap();
        }
        assert!(argoverse2.names.iter().all(|name| taxonomy::from_argoverse2(name).is_some()));
        assert!(nuscenes.names.iter().all(|name| shared.index(name).is_some()));
        assert_eq!((nuscenes.index("construction_vehicle"), nuscenes.index("Car")), (Some(2), None));
    }

    #[test]
    fn boxes_of_any_dataset_find_their_name_in_any_table() {
        let name = |table: LayoutClasses, source: &str, class| {
            table.name_of(&annotated(source, class)).map(str::to_owned).unwrap_or_default()
        };
        use ObjectClass::{Bus, Car, Other, Sign, Truck};
        assert_eq!(name(LayoutClasses::nuscenes(), "vehicle.bus.rigid", Bus), "bus");
        assert_eq!(name(LayoutClasses::argoverse2(), "vehicle.bus.rigid", Bus), "BUS");
        assert_eq!(name(LayoutClasses::argoverse2(), "SCHOOL_BUS", Bus), "SCHOOL_BUS");
        assert_eq!(name(LayoutClasses::nuscenes(), "SCHOOL_BUS", Bus), "bus");
        assert_eq!(
            name(LayoutClasses::argoverse2(), "MOBILE_PEDESTRIAN_SIGN", Sign),
            "MOBILE_PEDESTRIAN_CROSSING_SIGN"
        );
        assert_eq!(name(LayoutClasses::shared(), "REGULAR_VEHICLE", Car), "car");
        assert_eq!(name(LayoutClasses::shared(), "BOLLARD", Other), "other");
        assert_eq!(name(LayoutClasses::nuscenes(), "BOLLARD", Other), "", "no detection class");
        let two = LayoutClasses { names: vec!["car".into(), "pedestrian".into()] };
        assert_eq!(name(two, "vehicle.truck", Truck), "", "a table may be smaller than the taxonomy");
    }

    #[test]
    fn unusable_tables_say_why() {
        let why = |names: &[&str]| LayoutClasses::of(names).check().unwrap_err().to_string();
        assert!(why(&[]).contains("empty") && why(&["car", ""]).contains("name 1"));
        assert!(why(&["car", "bus", "car"]).contains("car occurs twice"));
    }
}
