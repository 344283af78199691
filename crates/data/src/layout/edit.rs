//! Changes of a layout, one sentence each, such as `move:car-3:dx=2,dyaw=15deg`.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use geometry::OrientedBox;
use geometry::glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::{Layout, LayoutBox, LayoutClasses, LayoutError};
use crate::{ObjectClass, taxonomy};

/// A change of a layout. Written as text, on the command line and in files alike:
///
/// | text | meaning |
/// |---|---|
/// | `remove:car-3` | takes the box away |
/// | `move:car-3:dx=2,dy=-1,dz=0,dyaw=15deg` | shifts it along the car's axes (metres), turns it about its own vertical |
/// | `move:car-3:x=20,y=3.5` | puts its centre there; what is not named stays |
/// | `rotate:car-3:dyaw=90deg` or `rotate:car-3:yaw=0` | turns it, or sets its heading |
/// | `resize:car-3:l=5,w=2,h=1.6` or `resize:car-3:scale=1.2` | new size; the middle of its bottom stays where it is |
/// | `add:car:x=15,y=-3` | a new box; also `z`, `l`, `w`, `h`, `yaw`, `id` |
/// | `reclass:car-3:truck` | another class, the same shape |
///
/// Angles are radians, or degrees with the ending `deg`. `car-*` in place of an id means every box whose id begins so, be it
/// none, `*` every box.
/// A box that is added without a size gets a usual one of its class, without `z` it stands on the ground plane of the car's frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct LayoutEdit {
    text: String,
    change: Change,
}

#[derive(Debug, Clone, PartialEq)]
enum Change {
    Remove(String),
    Place { id: String, numbers: Numbers },
    Resize { id: String, numbers: Numbers },
    Add { class: String, id: Option<String>, numbers: Numbers },
    Reclass { id: String, class: String },
}

/// `key=value` pairs with different keys.
type Numbers = Vec<(String, f64)>;

fn number(numbers: &Numbers, key: &str) -> Option<f64> {
    numbers.iter().find(|pair| pair.0 == key).map(|pair| pair.1)
}

impl FromStr for LayoutEdit {
    type Err = LayoutError;

    fn from_str(text: &str) -> Result<Self, LayoutError> {
        let change = parse(text).map_err(|why| LayoutError::Edit { edit: text.to_owned(), why })?;
        Ok(Self { text: text.to_owned(), change })
    }
}

impl TryFrom<String> for LayoutEdit {
    type Error = LayoutError;

    fn try_from(text: String) -> Result<Self, LayoutError> {
        text.parse()
    }
}

impl From<LayoutEdit> for String {
    fn from(edit: LayoutEdit) -> Self {
        edit.text
    }
}

impl fmt::Display for LayoutEdit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

const FORMS: &str = "remove:ID, move:ID:dx=1,dy=0,dyaw=15deg, rotate:ID:dyaw=90deg, resize:ID:l=5,w=2,h=1.6, \
                     add:CLASS:x=15,y=-3,yaw=0, reclass:ID:CLASS";

fn parse(text: &str) -> Result<Change, String> {
    let mut parts = text.splitn(3, ':');
    let verb = parts.next().unwrap_or_default();
    let name = parts.next().filter(|name| !name.is_empty());
    let rest = parts.next();
    let name = name.map(str::to_owned).ok_or_else(|| format!("write one of {FORMS}"))?;
    let needed = || rest.ok_or_else(|| format!("it ends early; write one of {FORMS}"));
    match verb {
        "remove" if rest.is_none() => Ok(Change::Remove(name)),
        "move" => {
            let numbers = numbers(needed()?, &["dx", "dy", "dz", "dyaw", "x", "y", "z", "yaw"])?;
            Ok(Change::Place { id: name, numbers })
        }
        "rotate" => Ok(Change::Place { id: name, numbers: numbers(needed()?, &["dyaw", "yaw"])? }),
        "resize" => Ok(Change::Resize { id: name, numbers: numbers(needed()?, &["l", "w", "h", "scale"])? }),
        "reclass" => Ok(Change::Reclass { id: name, class: needed()?.to_owned() }),
        "add" => {
            let (ids, others): (Vec<&str>, Vec<&str>) =
                needed()?.split(',').partition(|pair| pair.trim_start().starts_with("id="));
            let id = match ids.as_slice() {
                [] => None,
                [one] => one.split_once('=').map(|pair| pair.1.trim().to_owned()),
                _ => return Err("id is given twice".to_owned()),
            };
            let numbers = numbers(&others.join(","), &["x", "y", "z", "l", "w", "h", "yaw"])?;
            for key in ["x", "y"] {
                if number(&numbers, key).is_none() {
                    return Err(format!("say where: {key}= is missing"));
                }
            }
            Ok(Change::Add { class: name, id, numbers })
        }
        _ => Err(format!("write one of {FORMS}")),
    }
}

fn numbers(text: &str, allowed: &[&str]) -> Result<Numbers, String> {
    let mut found = Numbers::new();
    for pair in text.split(',') {
        let Some((key, value)) = pair.split_once('=').map(|(key, value)| (key.trim(), value.trim())) else {
            return Err(format!("{pair:?} should be key=value with a key of {}", allowed.join(", ")));
        };
        if !allowed.contains(&key) {
            return Err(format!("{key:?} is unknown here; the keys are {}", allowed.join(", ")));
        }
        if number(&found, key).is_some() {
            return Err(format!("{key} is given twice"));
        }
        let value = parse_number(value, key.ends_with("yaw")).ok_or_else(|| format!("{value:?} is no number"))?;
        found.push((key.to_owned(), value));
    }
    Ok(found)
}

fn parse_number(text: &str, is_angle: bool) -> Option<f64> {
    let value: f64 = match text.strip_suffix("deg").filter(|_| is_angle) {
        Some(degrees) => degrees.trim().parse::<f64>().ok()?.to_radians(),
        None => text.parse().ok()?,
    };
    value.is_finite().then_some(value)
}

impl Layout {
    /// The layout after these changes, in order.
    ///
    /// # Errors
    /// [`LayoutError::Edit`] for a change that names no box, an unknown class or an id that is taken; as [`Layout::check`] for what comes out.
    pub fn edited(&self, edits: &[LayoutEdit], classes: &LayoutClasses) -> Result<Self, LayoutError> {
        let mut layout = self.clone();
        for edit in edits {
            let refuse = |why: String| LayoutError::Edit { edit: edit.text.clone(), why };
            layout.apply(&edit.change, classes).map_err(refuse)?;
        }
        layout.check()?;
        Ok(layout)
    }

    fn apply(&mut self, change: &Change, classes: &LayoutClasses) -> Result<(), String> {
        match change {
            Change::Remove(id) => {
                let chosen: BTreeSet<usize> = self.named(id)?.into_iter().collect();
                let mut at = 0..;
                self.boxes.retain(|_| at.next().is_some_and(|at| !chosen.contains(&at)));
            }
            Change::Place { id, numbers } => self.each(id, |found| place(&mut found.shape, numbers))?,
            Change::Resize { id, numbers } => self.each(id, |found| resize(&mut found.shape, numbers))?,
            Change::Reclass { id, class } => {
                known(class, classes)?;
                self.each(id, |found| found.class.clone_from(class))?;
            }
            Change::Add { class, id, numbers } => {
                known(class, classes)?;
                let id = match id {
                    Some(id) if self.boxes.iter().any(|found| found.id == *id) => {
                        return Err(format!("a box is called {id:?} already"));
                    }
                    Some(id) => id.clone(),
                    None => self.free_id(class),
                };
                self.boxes.push(LayoutBox::new(id, class, new_shape(class, numbers)));
            }
        }
        Ok(())
    }

    fn each(&mut self, id: &str, mut change: impl FnMut(&mut LayoutBox)) -> Result<(), String> {
        for at in self.named(id)? {
            self.boxes.get_mut(at).into_iter().for_each(&mut change);
        }
        Ok(())
    }

    /// The boxes that an id or a beginning with `*` names.
    fn named(&self, id: &str) -> Result<Vec<usize>, String> {
        let fits = |found: &LayoutBox| match id.strip_suffix('*') {
            Some(start) => found.id.starts_with(start),
            None => found.id == id,
        };
        let chosen: Vec<usize> =
            self.boxes.iter().enumerate().filter(|(_, found)| fits(found)).map(|(at, _)| at).collect();
        if chosen.is_empty() && !id.ends_with('*') {
            let ids: Vec<&str> = self.boxes.iter().take(20).map(|found| found.id.as_str()).collect();
            let more = if self.boxes.len() > ids.len() { ", ..." } else { "" };
            return Err(format!("no box is called {id:?}; there are {}{more}", ids.join(", ")));
        }
        Ok(chosen)
    }

    fn free_id(&self, class: &str) -> String {
        let taken: BTreeSet<&str> = self.boxes.iter().map(|found| found.id.as_str()).collect();
        let ids = (1..).map(|number| format!("{}-{number}", class.to_lowercase()));
        ids.into_iter().find(|id| !taken.contains(id.as_str())).unwrap_or_default()
    }
}

fn known(class: &str, classes: &LayoutClasses) -> Result<(), String> {
    match classes.index(class) {
        Some(_) => Ok(()),
        None => Err(format!("the class {class:?} is unknown; the classes are {}", classes.names.join(", "))),
    }
}

fn place(shape: &mut OrientedBox, numbers: &Numbers) {
    let of = |key| number(numbers, key);
    let OrientedBox { center, rotation, .. } = shape;
    for (value, set, shift) in [(&mut center.x, "x", "dx"), (&mut center.y, "y", "dy"), (&mut center.z, "z", "dz")] {
        *value = of(set).unwrap_or(*value) + of(shift).unwrap_or(0.0);
    }
    if let Some(yaw) = of("yaw") {
        *rotation = DQuat::from_rotation_z(yaw);
    }
    if let Some(turn) = of("dyaw") {
        *rotation = (DQuat::from_rotation_z(turn) * *rotation).normalize();
    }
}

fn resize(shape: &mut OrientedBox, numbers: &Numbers) {
    let of = |key| number(numbers, key);
    let bottom = shape.center - shape.rotation * DVec3::new(0.0, 0.0, 0.5 * shape.size.z);
    let old = shape.size;
    let named = DVec3::new(of("l").unwrap_or(old.x), of("w").unwrap_or(old.y), of("h").unwrap_or(old.z));
    shape.size = named * of("scale").unwrap_or(1.0);
    shape.center = bottom + shape.rotation * DVec3::new(0.0, 0.0, 0.5 * shape.size.z);
}

fn new_shape(class: &str, numbers: &Numbers) -> OrientedBox {
    let of = |key| number(numbers, key);
    let usual = usual_size(shared_class(class));
    let size = DVec3::new(of("l").unwrap_or(usual.x), of("w").unwrap_or(usual.y), of("h").unwrap_or(usual.z));
    let z = of("z").unwrap_or(0.5 * size.z);
    let center = DVec3::new(of("x").unwrap_or_default(), of("y").unwrap_or_default(), z);
    OrientedBox { center, size, rotation: DQuat::from_rotation_z(of("yaw").unwrap_or_default()) }
}

/// The shared class behind a class name of any table; `Other` for a name that none has.
pub(crate) fn shared_class(name: &str) -> ObjectClass {
    let shared = ObjectClass::ALL.into_iter().find(|class| class.name() == name);
    shared.or_else(|| taxonomy::from_argoverse2(name)).unwrap_or(ObjectClass::Other)
}

/// Length, width and height in metres, rounded means of the nuScenes training annotations (signs and animals: our choice).
const fn usual_size(class: ObjectClass) -> DVec3 {
    match class {
        ObjectClass::Car => DVec3::new(4.6, 1.95, 1.75),
        ObjectClass::Truck => DVec3::new(6.9, 2.5, 2.85),
        ObjectClass::Bus => DVec3::new(11.0, 2.95, 3.5),
        ObjectClass::Trailer => DVec3::new(12.3, 2.9, 3.9),
        ObjectClass::ConstructionVehicle => DVec3::new(6.4, 2.85, 3.2),
        ObjectClass::Motorcycle => DVec3::new(2.1, 0.75, 1.45),
        ObjectClass::Bicycle => DVec3::new(1.7, 0.6, 1.3),
        ObjectClass::Pedestrian => DVec3::new(0.75, 0.65, 1.75),
        ObjectClass::TrafficCone => DVec3::new(0.4, 0.4, 1.05),
        ObjectClass::Barrier => DVec3::new(0.5, 2.5, 1.0),
        ObjectClass::Sign => DVec3::new(0.2, 0.75, 2.2),
        ObjectClass::Animal => DVec3::new(0.75, 0.35, 0.6),
        ObjectClass::Other => DVec3::ONE,
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use geometry::Box3d;

    use super::*;

    fn street() -> Layout {
        let shape = |x: f64| Box3d { center: DVec3::new(x, 2.0, 0.9), size: DVec3::new(4.0, 2.0, 1.8), yaw: 0.0 };
        let boxes = vec![
            LayoutBox::new("car-1", "car", shape(10.0)),
            LayoutBox::new("car-2", "car", shape(20.0)),
            LayoutBox::new("bus-1", "bus", shape(30.0)),
        ];
        Layout { boxes }
    }

    fn edited(edits: &[&str]) -> Result<Layout, LayoutError> {
        let edits = edits.iter().map(|text| text.parse()).collect::<Result<Vec<LayoutEdit>, _>>()?;
        street().edited(&edits, &LayoutClasses::nuscenes())
    }

    fn ids(layout: &Layout) -> Vec<&str> {
        layout.boxes.iter().map(|found| found.id.as_str()).collect()
    }

    #[test]
    fn boxes_are_removed_by_id_or_by_beginning() {
        assert_eq!(ids(&edited(&["remove:car-1"]).unwrap()), ["car-2", "bus-1"]);
        assert_eq!(ids(&edited(&["remove:car-*"]).unwrap()), ["bus-1"]);
        assert!(edited(&["remove:*"]).unwrap().boxes.is_empty());
        assert_eq!(edited(&["remove:truck-*"]).unwrap(), street(), "a beginning may be nobody's");
        let error = edited(&["remove:car-9"]).unwrap_err().to_string();
        assert!(error.contains("car-9") && error.contains("bus-1"), "{error}");
    }

    #[test]
    fn moves_are_shifts_or_places_in_metres_and_degrees() {
        let moved = edited(&["move:car-2:dx=2,dy=-1.5,dyaw=90deg"]).unwrap().boxes[1].clone();
        assert_eq!(moved.shape.center, DVec3::new(22.0, 0.5, 0.9));
        assert!((moved.shape.upright().yaw - FRAC_PI_2).abs() < 1e-12);
        let placed = edited(&["move:car-2:x=5", "rotate:car-2:yaw=0.5", "rotate:car-2:dyaw=0.25"]).unwrap();
        assert_eq!(placed.boxes[1].shape.center, DVec3::new(5.0, 2.0, 0.9));
        assert!((placed.boxes[1].shape.upright().yaw - 0.75).abs() < 1e-12);
        let all = edited(&["move:*:dz=1"]).unwrap();
        assert!(all.boxes.iter().all(|found| found.shape.center.z == 1.9));
        assert_eq!(all.boxes[0].shape.rotation, street().boxes[0].shape.rotation);
    }

    #[test]
    fn a_resized_box_stays_on_its_ground() {
        let grown = edited(&["resize:car-1:h=3.8,l=6"]).unwrap().boxes[0].shape;
        assert_eq!(grown.size, DVec3::new(6.0, 2.0, 3.8));
        assert!((grown.center.z - 0.5 * grown.size.z).abs() < 1e-12);
        let scaled = edited(&["resize:car-1:scale=0.5"]).unwrap().boxes[0].shape;
        assert_eq!(scaled.size, DVec3::new(2.0, 1.0, 0.9));
        assert!((scaled.center - DVec3::new(10.0, 2.0, 0.45)).length() < 1e-12);
        assert!(matches!(edited(&["resize:car-1:l=0"]), Err(LayoutError::Size { .. })));
    }

    #[test]
    fn added_boxes_get_a_usual_size_a_place_on_the_ground_and_a_free_id() {
        let layout = edited(&["add:car:x=15,y=-3", "add:pedestrian:x=8,y=2,yaw=90deg,id=walker,h=1.5,z=1"]).unwrap();
        assert_eq!(ids(&layout), ["car-1", "car-2", "bus-1", "car-3", "walker"]);
        let [car, walker] = [&layout.boxes[3], &layout.boxes[4]];
        assert!(car.shape.size.x > 4.0 && (car.shape.center.z - 0.5 * car.shape.size.z).abs() < 1e-12);
        assert_eq!((walker.shape.size.z, walker.shape.center.z), (1.5, 1.0));
        assert!(edited(&["add:car:x=1,y=2,id=car-1"]).unwrap_err().to_string().contains("already"));
    }

    #[test]
    fn classes_change_by_name_and_unknown_ones_are_refused() {
        let layout = edited(&["reclass:car-*:truck"]).unwrap();
        assert_eq!(
            layout.boxes.iter().map(|found| found.class.as_str()).collect::<Vec<_>>(),
            ["truck", "truck", "bus"]
        );
        assert_eq!(ids(&layout), ids(&street()));
        for edit in ["reclass:car-1:tank", "add:tank:x=1,y=1"] {
            let error = edited(&[edit]).unwrap_err().to_string();
            assert!(error.contains("tank") && error.contains("construction_vehicle"), "{error}");
        }
    }

    #[test]
    fn typos_name_the_edit_and_the_way_to_write_it() {
        for (edit, cure) in [
            ("delete:car-1", "remove:ID"),
            ("remove", "remove:ID"),
            ("remove:car-1:now", "remove:ID"),
            ("move:car-1", "ends early"),
            ("move:car-1:north=3", "dx, dy"),
            ("move:car-1:dx", "key=value"),
            ("move:car-1:dx=two", "no number"),
            ("move:car-1:dx=nan", "no number"),
            ("move:car-1:dx=2deg", "no number"),
            ("move:car-1:dx=2,dx=3", "twice"),
            ("add:car:x=2", "y= is missing"),
            ("reclass:car-1", "ends early"),
        ] {
            let error = edited(&[edit]).unwrap_err().to_string();
            assert!(error.contains(cure) && error.contains(&format!("{edit:?}")), "{edit}: {error}");
        }
    }

    #[test]
    fn edits_are_text_in_files() {
        let edit: LayoutEdit = serde_json::from_str("\"move:car-1:dx=2\"").unwrap();
        assert_eq!(serde_json::to_string(&edit).unwrap(), "\"move:car-1:dx=2\"");
        assert!(serde_json::from_str::<LayoutEdit>("\"mvoe:car-1:dx=2\"").is_err());
    }
}
