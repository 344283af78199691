//! The semantic prior: an 8-bit grey picture of a map, 10 px/m, 255 on road and sidewalk, row 0 at the northern edge.

use std::path::Path;

use glam::DVec2;
use image::{GrayImage, ImageFormat};

use crate::DataError;

const PIXELS_PER_M: f64 = 10.0;
/// As large as the largest map of the release: 1.2 GB decoded, which tools hold in memory. About forty worlds of 20 s fit.
const MOST_PIXELS: f64 = 1.2e9;

/// A polygon: its outer ring and its holes, rings not closed.
pub(super) type Rings = Vec<Vec<DVec2>>;

/// # Errors
/// [`DataError::Config`] when so many scenes lie on the map that no tool could load the picture.
pub(super) fn write(path: &Path, canvas_m: DVec2, areas: &[Rings]) -> Result<(), DataError> {
    let size = (canvas_m * PIXELS_PER_M).ceil();
    if size.x * size.y > MOST_PIXELS {
        return Err(DataError::Config(format!(
            "the map would cover {:.0} m x {:.0} m, more than tools can load; write fewer scenes per dataset",
            canvas_m.x, canvas_m.y
        )));
    }
    let mut picture = GrayImage::new(size.x as u32, size.y as u32);
    for rings in areas {
        fill(&mut picture, rings);
    }
    picture
        .save_with_format(path, ImageFormat::Png)
        .map_err(|e| DataError::Image { why: e.to_string(), path: path.to_owned() })
}

/// Sets the pixels whose centres lie inside the polygon, by the even-odd rule.
fn fill(picture: &mut GrayImage, rings: &Rings) {
    let (width, height) = picture.dimensions();
    let to_pixel = |p: &DVec2| DVec2::new(p.x * PIXELS_PER_M, f64::from(height) - p.y * PIXELS_PER_M);
    let edges: Vec<(DVec2, DVec2)> = rings
        .iter()
        .flat_map(|ring| ring.iter().zip(ring.iter().cycle().skip(1)).map(|(a, b)| (to_pixel(a), to_pixel(b))))
        .collect();
    let lowest = edges.iter().map(|(a, _)| a.y).fold(f64::INFINITY, f64::min).floor().max(0.0);
    let highest = edges.iter().map(|(a, _)| a.y).fold(0.0, f64::max).ceil().min(f64::from(height));
    for row in lowest as u32..highest as u32 {
        let y = f64::from(row) + 0.5;
        let crosses =
            |(a, b): &(DVec2, DVec2)| ((a.y <= y) != (b.y <= y)).then(|| a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x));
        let mut crossings: Vec<f64> = edges.iter().filter_map(crosses).collect();
        crossings.sort_by(f64::total_cmp);
        for span in crossings.chunks_exact(2) {
            let first = (span[0] - 0.5).ceil().max(0.0) as u32;
            let end = ((span[1] - 0.5).ceil().max(0.0) as u32).min(width);
            for column in first..end {
                picture.put_pixel(column, row, image::Luma([255]));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_zero_is_north_and_holes_stay_empty() {
        let square = |low: f64, high: f64| {
            [(low, low), (high, low), (high, high), (low, high)].map(|(x, y)| DVec2::new(x, y)).to_vec()
        };
        let mut picture = GrayImage::new(40, 30);
        fill(&mut picture, &vec![square(0.0, 2.0), square(0.5, 1.0)]);
        // 2 m x 2 m in the south-west corner of a 4 m x 3 m map.
        assert_eq!(picture.get_pixel(0, 29).0, [255]);
        assert_eq!(picture.get_pixel(19, 10).0, [255]);
        assert_eq!(picture.get_pixel(19, 9).0, [0]);
        assert_eq!(picture.get_pixel(20, 10).0, [0]);
        assert_eq!(picture.get_pixel(7, 22).0, [0]);
        assert_eq!(picture.pixels().filter(|p| p.0 == [255]).count(), 400 - 25);
    }

    #[test]
    fn a_map_that_no_tool_can_load_is_refused() {
        let error = write(Path::new("unused.png"), DVec2::splat(5000.0), &[]).unwrap_err();
        assert!(error.to_string().contains("fewer scenes"));
    }
}
