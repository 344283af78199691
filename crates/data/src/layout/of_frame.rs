//! From a dataset's frame to its layout.

use std::collections::BTreeMap;

use super::{Layout, LayoutBox, LayoutClasses};
use crate::{ObjectBox, SceneFrame};

impl Layout {
    /// The boxes of a frame that the table has a class for, nearest first; a frame without annotations gives an empty layout.
    ///
    /// Ids are the class and a number from 1 by distance from the car (`car-1` is the nearest car); the dataset's own identity is kept
    /// as the track.
    pub fn of_frame(frame: &SceneFrame, classes: &LayoutClasses) -> Self {
        Self::of_boxes(frame.boxes.as_deref().unwrap_or_default(), classes)
    }

    /// The same of a list of boxes.
    pub fn of_boxes(boxes: &[ObjectBox], classes: &LayoutClasses) -> Self {
        let mut named: Vec<(&str, &ObjectBox)> =
            boxes.iter().filter_map(|found| Some((classes.name_of(found)?, found))).collect();
        named.sort_by(|a, b| {
            let distance = |found: &ObjectBox| found.box3d.center.length_squared();
            distance(a.1).total_cmp(&distance(b.1))
        });
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        let boxes = named
            .into_iter()
            .map(|(class, found)| {
                let number = counts.entry(class).or_default();
                *number += 1;
                let id = format!("{}-{number}", class.to_lowercase());
                LayoutBox { track: Some(found.track.clone()), ..LayoutBox::new(id, class, found.box3d) }
            })
            .collect();
        Self { boxes }
    }
}
