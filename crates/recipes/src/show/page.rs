//! Where everything stands on a page: views in ring order in rows, the panel from above beside them, the legend below.

use data::View;
use geometry::CameraRig;
use image::RgbImage;

use super::canvas::Canvas;
use super::objects::surface;
use super::{Layer, PageContent, PageOptions, bev, colors, legend, view};

/// Pixels between pictures.
const GAP: u32 = 4;
/// Smallest page that can be read, px.
const LEAST_WIDTH: u32 = 320;
/// Page width per size of letter, px.
const WIDTH_PER_SCALE: u32 = 1400;
/// Most views in a row.
const MOST_COLUMNS: usize = 4;

/// Draws a page.
///
/// # Errors
/// Pictures that cannot be read, naming the file; calibration that cannot be used.
pub fn draw_page(mut content: PageContent, options: &PageOptions) -> anyhow::Result<RgbImage> {
    let width = options.width.max(LEAST_WIDTH);
    let scale = width.div_ceil(WIDTH_PER_SCALE);
    let (order, closed) = ring(&content.frame.rig())?;
    let views = std::mem::take(&mut content.frame.views);
    // Numbers in the panel from above follow the ring.
    content.frame.views = order.iter().filter_map(|at| views.get(*at).cloned()).collect();
    let rows = rows(content.frame.views.len(), closed);
    let layout = Layout::of(&content.frame.views, &rows, width);

    let has = |layer| options.layers.contains(&layer);
    let grid = content.occupancy.as_ref().filter(|_| has(Layer::OccupancyInViews));
    let cells = grid.map(|grid| (surface(grid), grid.grid.cell_size().z));
    let strip = legend::draw(&content, width, scale);
    let mut page = Canvas::new(width, layout.height + strip.picture.height(), colors::PAPER);
    for (row, places) in rows.iter().enumerate() {
        let mut x = GAP;
        let y = GAP + row as u32 * (layout.row_height + GAP);
        for (place, view) in places.iter().filter_map(|place| Some((*place, content.frame.views.get(*place)?))) {
            let size = (layout.view_width(view), layout.row_height);
            let cells = cells.as_ref().map(|(cells, side)| (cells.as_slice(), *side));
            page.paste(&view::draw(&content, place, size, scale, cells)?.picture, x, y);
            x += size.0 + GAP;
        }
    }
    let above = bev::draw(&content, options, layout.side, scale);
    page.paste(&above.picture, width - GAP - layout.side, GAP);
    page.paste(&strip.picture, 0, layout.height);
    Ok(page.picture)
}

/// Views from left to right around the car, and whether they close. A ring is turned so that the front view stands in the middle of the
/// first row.
fn ring(rig: &CameraRig) -> anyhow::Result<(Vec<usize>, bool)> {
    let mut order = rig.rig_order()?;
    let closed = rig.adjacency()?.closed;
    if closed {
        let columns = columns(order.len());
        order.rotate_right((columns - 1) / 2);
    }
    Ok((order, closed))
}

fn columns(views: usize) -> usize {
    views.div_ceil(2).clamp(1, MOST_COLUMNS)
}

/// Places of the views by row. Small open chains stay in one row, left to right.
fn rows(views: usize, closed: bool) -> Vec<Vec<usize>> {
    let columns = if closed || views > MOST_COLUMNS { columns(views) } else { views.max(1) };
    let places: Vec<usize> = (0..views).collect();
    places.chunks(columns).map(<[usize]>::to_vec).collect()
}

struct Layout {
    row_height: u32,
    /// Of the panel from above.
    side: u32,
    /// Of all rows.
    height: u32,
}

impl Layout {
    /// Rows of equal height that fill the width together with a square as high as all rows.
    fn of(views: &[View], rows: &[Vec<usize>], width: u32) -> Self {
        let row_aspect = |row: &Vec<usize>| row.iter().filter_map(|at| views.get(*at)).map(aspect).sum::<f64>();
        let widest = rows.iter().map(row_aspect).fold(0.0, f64::max);
        let most = rows.iter().map(Vec::len).max().unwrap_or(0);
        let count = rows.len().max(1) as f64;
        let gaps = f64::from(GAP) * (most as f64 + 2.0 + count - 1.0);
        let row_height = (((f64::from(width) - gaps) / (widest + count)).floor() as u32).max(8);
        let side = row_height * count as u32 + GAP * (count as u32 - 1);
        Self { row_height, side, height: side + 2 * GAP }
    }

    fn view_width(&self, view: &View) -> u32 {
        ((f64::from(self.row_height) * aspect(view)).floor() as u32).max(1)
    }
}

fn aspect(view: &View) -> f64 {
    f64::from(view.intrinsics.width) / f64::from(view.intrinsics.height)
}

#[cfg(test)]
mod tests {
    use geometry::RigPreset;

    use super::*;

    #[test]
    fn rings_have_the_front_in_the_middle_of_the_first_row() {
        let places = |preset: RigPreset| {
            let (order, closed) = ring(&preset.rig()).unwrap();
            rows(order.len(), closed)
                .iter()
                .map(|row| row.iter().map(|at| order[*at]).collect())
                .collect::<Vec<Vec<_>>>()
        };
        // The presets list their cameras in rig order.
        assert_eq!(places(RigPreset::NuScenes), [vec![5, 0, 1], vec![2, 3, 4]]);
        assert_eq!(places(RigPreset::Argoverse2), [vec![6, 0, 1, 2], vec![3, 4, 5]]);
        assert_eq!(places(RigPreset::NuPlan), [vec![7, 0, 1, 2], vec![3, 4, 5, 6]]);
        assert_eq!(places(RigPreset::WayveScenes101), [vec![4, 0, 1], vec![2, 3]]);
        assert_eq!(places(RigPreset::Waymo), [vec![0, 1, 2], vec![3, 4]], "an open chain begins at its left end");
        assert_eq!(rows(1, false), [vec![0]]);
        assert!(rows(0, false).is_empty());
    }
}
