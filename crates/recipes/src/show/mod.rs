//! Contact sheets of frames: every view with boxes, map and occupancy drawn where its own calibration and pose put them, and the same
//! things from above. What does not fit together shows at a glance.

mod bev;
pub(crate) mod canvas;
mod colors;
mod legend;
mod objects;
mod page;
mod project;
mod view;

use data::{DataError, LocalMap, OccupancyGrid, SceneDataset, SceneFrame};

pub use page::draw_page;

/// What is drawn beside the pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum Layer {
    /// Annotated boxes
    Boxes,
    /// Vector map
    Map,
    /// Occupancy from above
    Occupancy,
    /// Occupancy in the pictures
    OccupancyInViews,
    /// Pixels to ignore
    Masks,
    /// Names of boxes, from above
    Names,
}

/// How a page is drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct PageOptions {
    /// Width of the page, px.
    pub width: u32,
    /// Half side of the square that is drawn from above, metres; lines of the map beyond it are not drawn.
    pub range_m: f64,
    /// What is drawn.
    pub layers: Vec<Layer>,
}

/// Everything on one page.
#[derive(Debug)]
pub struct PageContent {
    /// The frame; boxes are taken out where they are not asked for.
    pub frame: SceneFrame,
    /// The map around the car.
    pub map: LocalMap,
    /// Occupancy labels.
    pub occupancy: Option<OccupancyGrid>,
    /// Parts that were asked for and that this frame lacks.
    pub lacking: Vec<String>,
}

impl PageContent {
    /// Reads a frame with the asked layers. A layer that the dataset does not have is left out; one that it has and that is broken is
    /// an error.
    ///
    /// # Errors
    /// As the dataset's methods.
    pub fn read(dataset: &dyn SceneDataset, index: usize, options: &PageOptions) -> Result<Self, DataError> {
        let asked = |layer| options.layers.contains(&layer);
        let mut frame = dataset.frame(index)?;
        let mut lacking = Vec::new();
        if !asked(Layer::Boxes) {
            frame.boxes = None;
        } else if frame.boxes.is_none() {
            lacking.push("boxes".to_owned());
        }
        let has = dataset.capabilities();
        let map = if asked(Layer::Map) {
            available("map", has.map.then(|| dataset.local_map(index, options.range_m)), &mut lacking)?
        } else {
            None
        };
        let occupancy = if asked(Layer::Occupancy) || asked(Layer::OccupancyInViews) {
            available("occupancy", has.occupancy.then(|| dataset.occupancy(index)), &mut lacking)?
        } else {
            None
        };
        if !asked(Layer::Masks) {
            frame.views.iter_mut().for_each(|view| view.mask = None);
        }
        Ok(Self { frame, map: map.unwrap_or_default(), occupancy, lacking })
    }
}

/// A layer that exists at some frames of a dataset only: its absence is told, any other fault is an error.
fn available<T>(
    what: &str,
    found: Option<Result<T, DataError>>,
    lacking: &mut Vec<String>,
) -> Result<Option<T>, DataError> {
    match found {
        Some(Ok(layer)) => return Ok(Some(layer)),
        Some(Err(error @ DataError::Missing { .. })) => tracing::warn!("no {what} here: {error}"),
        Some(Err(error)) => return Err(error),
        None => {}
    }
    lacking.push(what.to_owned());
    Ok(None)
}
