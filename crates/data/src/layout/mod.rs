//! Layouts: the boxes of one instant, as a condition that can be edited.
//!
//! Paper: "Scalable and Generalizable Autonomous Driving Scene Synthesis", section 3.2. A layout lies in the ego frame of one instant, in
//! metres and radians. Classes are names; a [`LayoutClasses`] table gives them numbers.

mod classes;
mod edit;
mod error;
mod file;
mod interpolate;
mod of_frame;
mod rasterise;

use std::collections::HashSet;

use geometry::OrientedBox;

pub use classes::LayoutClasses;
pub use edit::LayoutEdit;
pub(crate) use edit::shared_class;
pub use error::LayoutError;
pub use file::{FileBox, LayoutFile, LayoutSource};
pub use rasterise::Rasterise;

/// Most boxes of a layout. Crowded frames hold some hundreds; the bound keeps the cost of any file small.
pub const MOST_BOXES: usize = 10_000;

/// Boxes in the ego frame of one instant. No box at all is a legal layout: an empty street.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Layout {
    /// In any order.
    pub boxes: Vec<LayoutBox>,
}

/// One box of a layout.
#[derive(Debug, Clone, PartialEq)]
pub struct LayoutBox {
    /// What edits call it; unique in its layout.
    pub id: String,
    /// Name of its class.
    pub class: String,
    /// Where it is, ego frame, metres.
    pub shape: OrientedBox,
    /// Identity over time where it is known; boxes of one track are one object in [interpolation](Layout::interpolate).
    pub track: Option<String>,
}

impl LayoutBox {
    /// A box without identity over time.
    pub fn new(id: impl Into<String>, class: impl Into<String>, shape: impl Into<OrientedBox>) -> Self {
        Self { id: id.into(), class: class.into(), shape: shape.into(), track: None }
    }

    /// # Errors
    /// [`LayoutError::NotFinite`], [`LayoutError::Size`] and [`LayoutError::Rotation`].
    fn check(&self) -> Result<(), LayoutError> {
        let id = || self.id.clone();
        let OrientedBox { center, size, rotation } = self.shape;
        for (what, finite) in
            [("centre", center.is_finite()), ("size", size.is_finite()), ("rotation", rotation.is_finite())]
        {
            if !finite {
                return Err(LayoutError::NotFinite { id: id(), what });
            }
        }
        if size.min_element() <= 0.0 {
            return Err(LayoutError::Size { id: id(), size: size.to_array() });
        }
        if !rotation.is_normalized() {
            return Err(LayoutError::Rotation { id: id(), norm: rotation.length() });
        }
        Ok(())
    }
}

impl Layout {
    /// Checks what does not depend on classes or grids, at a cost linear in the boxes.
    ///
    /// # Errors
    /// [`LayoutError::TooMany`], [`LayoutError::DuplicateId`], and whatever is wrong with a box's numbers, naming its id.
    pub fn check(&self) -> Result<(), LayoutError> {
        if self.boxes.len() > MOST_BOXES {
            return Err(LayoutError::TooMany { count: self.boxes.len() });
        }
        let mut seen = HashSet::new();
        for found in &self.boxes {
            if !seen.insert(found.id.as_str()) {
                return Err(LayoutError::DuplicateId { id: found.id.clone() });
            }
            found.check()?;
        }
        Ok(())
    }

    /// # Errors
    /// [`LayoutError::Classes`] and [`LayoutError::UnknownClass`], naming the first box that the table has nothing for.
    pub fn check_classes(&self, classes: &LayoutClasses) -> Result<(), LayoutError> {
        classes.check()?;
        match self.boxes.iter().find(|found| classes.index(&found.class).is_none()) {
            None => Ok(()),
            Some(found) => Err(LayoutError::UnknownClass {
                id: found.id.clone(),
                class: found.class.clone(),
                known: classes.names.clone(),
            }),
        }
    }
}
