//! Lines, areas and letters on a picture. Positions are continuous pixels, centres at +0.5.

use font8x8::legacy::BASIC_LEGACY;
use geometry::glam::DVec2;
use image::{Rgb, RgbImage};

/// Red, green, blue.
pub(crate) type Color = [u8; 3];

/// Side of a letter at scale 1, px.
const LETTER: u32 = 8;

/// A picture that is drawn on; whatever lies outside is cut off.
#[derive(Debug, Clone)]
pub(crate) struct Canvas {
    pub(crate) picture: RgbImage,
}

impl Canvas {
    pub(crate) fn new(width: u32, height: u32, color: Color) -> Self {
        Self { picture: RgbImage::from_pixel(width, height, Rgb(color)) }
    }

    pub(crate) fn size(&self) -> DVec2 {
        DVec2::new(f64::from(self.picture.width()), f64::from(self.picture.height()))
    }

    /// Mixes a colour into one pixel; `amount` in [0, 1].
    pub(crate) fn blend(&mut self, x: i64, y: i64, color: Color, amount: f64) {
        let inside = u32::try_from(x).ok().zip(u32::try_from(y).ok());
        if let Some(pixel) = inside.and_then(|(x, y)| self.picture.get_pixel_mut_checked(x, y)) {
            for (old, new) in pixel.0.iter_mut().zip(color) {
                *old = (f64::from(*old) + amount * (f64::from(new) - f64::from(*old))).round() as u8;
            }
        }
    }

    pub(crate) fn rectangle(&mut self, low: DVec2, size: DVec2, color: Color, amount: f64) {
        let (low, high) = (low.max(DVec2::ZERO).round(), (low + size).min(self.size()).round());
        for y in low.y as i64..high.y as i64 {
            for x in low.x as i64..high.x as i64 {
                self.blend(x, y, color, amount);
            }
        }
    }

    /// A smooth straight line of this width.
    pub(crate) fn line(&mut self, from: DVec2, to: DVec2, color: Color, width: f64) {
        let Some((from, to)) = clip(from, to, DVec2::splat(-2.0 * width), self.size() + 2.0 * width) else { return };
        let steep = (to.y - from.y).abs() > (to.x - from.x).abs();
        let turned = |p: DVec2| if steep { DVec2::new(p.y, p.x) } else { p };
        let (mut a, mut b) = (turned(from), turned(to));
        if a.x > b.x {
            std::mem::swap(&mut a, &mut b);
        }
        let way = b - a;
        let slope = if way.x > 0.0 { way.y / way.x } else { 0.0 };
        // Distance across the line per pixel along the minor axis.
        let across = 1.0 / (1.0 + slope * slope).sqrt();
        let reach = (0.5 * width + 0.5) / across;
        for column in a.x.floor() as i64..=b.x.floor() as i64 {
            let middle = a.y + slope * ((column as f64 + 0.5).clamp(a.x, b.x) - a.x);
            for row in (middle - reach).floor() as i64..=(middle + reach).floor() as i64 {
                let distance = (row as f64 + 0.5 - middle).abs() * across;
                let amount = (0.5 * width + 0.5 - distance).clamp(0.0, 1.0);
                let (x, y) = if steep { (row, column) } else { (column, row) };
                self.blend(x, y, color, amount);
            }
        }
    }

    pub(crate) fn polyline(&mut self, points: &[DVec2], color: Color, width: f64) {
        for pair in points.windows(2) {
            if let [a, b] = pair {
                self.line(*a, *b, color, width);
            }
        }
    }

    /// The inside of rings by the even-odd rule, so that inner rings are holes.
    pub(crate) fn fill(&mut self, rings: &[Vec<DVec2>], color: Color, amount: f64) {
        let points = || rings.iter().flatten().filter(|point| point.is_finite());
        let low = points().fold(self.size().y, |low, point| low.min(point.y)).max(0.0) as i64;
        let high = points().fold(0.0f64, |high, point| high.max(point.y)).min(self.size().y) as i64;
        for y in low..=high {
            let row = y as f64 + 0.5;
            let mut crossings: Vec<f64> = rings.iter().flat_map(|ring| crossings(ring, row)).collect();
            crossings.sort_by(f64::total_cmp);
            for pair in crossings.chunks_exact(2) {
                if let [from, to] = pair {
                    let (from, to) = (from.max(0.0).round() as i64, to.min(self.size().x).round() as i64);
                    (from..to).for_each(|x| self.blend(x, y, color, amount));
                }
            }
        }
    }

    /// Letters of basic Latin, `scale` times 8 px high; others become `?`. Gives the x after the last letter.
    pub(crate) fn text(&mut self, at: DVec2, scale: u32, color: Color, text: &str) -> f64 {
        let (left, top) = (at.x.round() as i64, at.y.round() as i64);
        for (place, letter) in text.chars().enumerate() {
            let known = BASIC_LEGACY.get(letter as usize).or(BASIC_LEGACY.get('?' as usize));
            let left = left + place as i64 * i64::from(LETTER * scale);
            for (row, bits) in known.into_iter().flatten().enumerate() {
                for column in (0..LETTER).filter(|column| bits >> column & 1 == 1) {
                    for (dx, dy) in (0..scale * scale).map(|i| (i % scale, i / scale)) {
                        let x = left + i64::from(column * scale + dx);
                        self.blend(x, top + i64::from(row as u32 * scale + dy), color, 1.0);
                    }
                }
            }
        }
        at.x + text_width(text, scale)
    }

    /// Letters on a dark ground.
    pub(crate) fn label(&mut self, at: DVec2, scale: u32, color: Color, text: &str) {
        let pad = f64::from(scale) * 2.0;
        let size = DVec2::new(text_width(text, scale), f64::from(LETTER * scale)) + 2.0 * pad;
        self.rectangle(at, size, [0, 0, 0], 0.65);
        self.text(at + pad, scale, color, text);
    }

    pub(crate) fn paste(&mut self, picture: &RgbImage, x: u32, y: u32) {
        image::imageops::replace(&mut self.picture, picture, i64::from(x), i64::from(y));
    }
}

pub(crate) fn text_width(text: &str, scale: u32) -> f64 {
    text.chars().count() as f64 * f64::from(LETTER * scale)
}

/// Height of a line of text with its gap, px.
pub(crate) const fn line_height(scale: u32) -> u32 {
    LETTER * scale + 4 * scale
}

/// Where a closed ring crosses a row.
fn crossings(ring: &[DVec2], row: f64) -> Vec<f64> {
    let sides = ring.iter().zip(ring.iter().cycle().skip(1));
    sides
        .filter(|(a, b)| (a.y <= row) != (b.y <= row))
        .map(|(a, b)| a.x + (b.x - a.x) * (row - a.y) / (b.y - a.y))
        .collect()
}

/// The part of a segment inside a rectangle.
pub(crate) fn clip(from: DVec2, to: DVec2, low: DVec2, high: DVec2) -> Option<(DVec2, DVec2)> {
    if !(from.is_finite() && to.is_finite()) {
        return None;
    }
    let way = to - from;
    let (mut enter, mut leave) = (0.0f64, 1.0f64);
    for (start, way, low, high) in [(from.x, way.x, low.x, high.x), (from.y, way.y, low.y, high.y)] {
        if way == 0.0 {
            if start < low || start > high {
                return None;
            }
            continue;
        }
        let (s, t) = ((low - start) / way, (high - start) / way);
        enter = enter.max(s.min(t));
        leave = leave.min(s.max(t));
    }
    (enter <= leave).then(|| (from + way * enter, from + way * leave))
}

#[cfg(test)]
mod tests {
    use super::*;

    const RED: Color = [255, 0, 0];

    fn reds(canvas: &Canvas) -> usize {
        canvas.picture.pixels().filter(|pixel| pixel.0 == RED).count()
    }

    #[test]
    fn lines_have_their_width_and_are_cut_at_the_border() {
        let mut canvas = Canvas::new(20, 10, [0; 3]);
        canvas.line(DVec2::new(-1e9, 5.5), DVec2::new(1e9, 5.5), RED, 3.0);
        assert_eq!(reds(&canvas), 60);
        let mut steep = Canvas::new(10, 20, [0; 3]);
        steep.line(DVec2::new(5.5, 30.0), DVec2::new(5.5, -30.0), RED, 1.0);
        assert_eq!(reds(&steep), 20);
        steep.line(DVec2::new(f64::NAN, 0.0), DVec2::new(1.0, 1.0), RED, 1.0);
        steep.line(DVec2::new(30.0, 0.0), DVec2::new(30.0, 20.0), RED, 1.0);
        assert_eq!(reds(&steep), 20);
    }

    #[test]
    fn areas_have_holes() {
        let square = |low: f64, high: f64| {
            [(low, low), (high, low), (high, high), (low, high)].map(|(x, y)| DVec2::new(x, y)).to_vec()
        };
        let mut canvas = Canvas::new(20, 20, [0; 3]);
        canvas.fill(&[square(2.0, 12.0), square(4.0, 6.0)], RED, 1.0);
        assert_eq!(reds(&canvas), 100 - 4);
        canvas.fill(&[square(-100.0, 100.0)], RED, 1.0);
        assert_eq!(reds(&canvas), 400);
    }

    #[test]
    fn letters_stand_upright_and_unknown_ones_are_marked() {
        let mut canvas = Canvas::new(8, 8, [0; 3]);
        canvas.text(DVec2::ZERO, 1, RED, "L");
        let column = |x: u32| (0..8).filter(|y| canvas.picture.get_pixel(x, *y).0 == RED).count();
        assert!(column(1) > column(5) && canvas.picture.get_pixel(5, 6).0 == RED, "an L stands on its foot");
        let (mut unknown, mut mark) = (Canvas::new(8, 8, [0; 3]), Canvas::new(8, 8, [0; 3]));
        unknown.text(DVec2::ZERO, 1, RED, "\u{4e2d}");
        mark.text(DVec2::ZERO, 1, RED, "?");
        assert_eq!(unknown.picture, mark.picture);
    }
}
