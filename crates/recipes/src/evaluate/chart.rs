//! Bars and curves on a canvas.

use geometry::glam::DVec2;

use crate::show::canvas::{Canvas, Color, line_height, text_width};

pub(super) const PAPER: Color = [250, 250, 250];
pub(super) const INK: Color = [30, 30, 34];
const FAINT: Color = [200, 200, 206];
const BARS: Color = [86, 130, 190];
/// Told apart without red against green.
const CURVES: [Color; 8] = [
    [0, 90, 181],
    [220, 50, 32],
    [93, 58, 155],
    [230, 159, 0],
    [0, 158, 115],
    [90, 90, 90],
    [86, 180, 233],
    [204, 121, 167],
];

/// A rectangle of the page.
#[derive(Debug, Clone, Copy)]
pub(super) struct Area {
    pub(super) low: DVec2,
    pub(super) size: DVec2,
}

/// A histogram with its ends and a line at the mean.
pub(super) fn bars(canvas: &mut Canvas, area: Area, title: &str, histogram: &metrics::Histogram, mean: Option<f64>) {
    let inner = frame(canvas, area, title);
    let (low, high) = histogram.range();
    let most = histogram.counts().iter().copied().max().unwrap_or(0).max(1) as f64;
    let step = inner.size.x / histogram.counts().len().max(1) as f64;
    for (at, count) in histogram.counts().iter().enumerate() {
        let height = inner.size.y * *count as f64 / most;
        let corner = inner.low + DVec2::new(at as f64 * step, inner.size.y - height);
        canvas.rectangle(corner, DVec2::new((step - 1.0).max(1.0), height), BARS, 1.0);
    }
    if let Some(mean) = mean {
        let x = inner.low.x + ((mean - low) / (high - low)).clamp(0.0, 1.0) * inner.size.x;
        canvas.line(DVec2::new(x, inner.low.y), DVec2::new(x, inner.low.y + inner.size.y), CURVES[1], 2.0);
    }
    ends(canvas, inner, [&format!("{low}"), &format!("{high}")]);
}

/// A named curve of points with ascending x.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// For the legend.
    pub name: String,
    /// x and y.
    pub points: Vec<[f64; 2]>,
}

/// Curves over a common x axis, every curve scaled to its own range of values so that their shapes can be compared.
pub(super) fn curves(canvas: &mut Canvas, area: Area, title: &str, curves: &[Curve]) {
    let inner = frame(canvas, area, title);
    let xs = || curves.iter().flat_map(|curve| curve.points.iter().map(|point| point[0]));
    let (left, right) = (xs().fold(f64::INFINITY, f64::min), xs().fold(f64::NEG_INFINITY, f64::max));
    for (curve, color) in curves.iter().zip(CURVES.iter().cycle()) {
        let ys = || curve.points.iter().map(|point| point[1]);
        let (low, high) = (ys().fold(f64::INFINITY, f64::min), ys().fold(f64::NEG_INFINITY, f64::max));
        let share = |value: f64, low: f64, high: f64| if high > low { (value - low) / (high - low) } else { 0.5 };
        let place = |point: &[f64; 2]| {
            let (x, y) = (share(point[0], left, right), share(point[1], low, high));
            inner.low + DVec2::new(x, 1.0 - y) * inner.size
        };
        let line: Vec<DVec2> = curve.points.iter().map(place).collect();
        canvas.polyline(&line, *color, 2.0);
        line.iter().for_each(|point| canvas.rectangle(*point - 2.5, DVec2::splat(5.0), *color, 1.0));
    }
    ends(canvas, inner, [&format!("{left}"), &format!("{right}")]);
    let mut at = inner.low + DVec2::new(0.0, inner.size.y + f64::from(line_height(1)) * 1.5);
    for (curve, color) in curves.iter().zip(CURVES.iter().cycle()) {
        let value = |point: Option<&[f64; 2]>| point.map_or(f64::NAN, |point| point[1]);
        let (first, last) = (value(curve.points.first()), value(curve.points.last()));
        let text = format!("{}: {} to {}", curve.name, short(first), short(last));
        canvas.rectangle(at, DVec2::splat(8.0), *color, 1.0);
        canvas.text(at + DVec2::new(12.0, 0.0), 1, INK, &text);
        at.y += f64::from(line_height(1));
    }
}

/// Lines that the legend of `count` curves takes, px.
pub(super) fn legend_height(count: usize) -> f64 {
    f64::from(line_height(1)) * (count as f64 + 2.0)
}

/// Four digits that tell something.
pub(super) fn short(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 => format!("{value:.1}"),
        size if size >= 0.1 || size == 0.0 => format!("{value:.3}"),
        _ => format!("{value:.2e}"),
    }
}

/// Title and border; gives what is left inside.
fn frame(canvas: &mut Canvas, area: Area, title: &str) -> Area {
    canvas.text(area.low, 1, INK, title);
    let top = f64::from(line_height(1));
    let inner = Area { low: area.low + DVec2::new(0.0, top), size: area.size - DVec2::new(0.0, top) };
    let corners = [DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y, DVec2::ZERO];
    canvas.polyline(&corners.map(|corner| inner.low + corner * inner.size), FAINT, 1.0);
    inner
}

fn ends(canvas: &mut Canvas, inner: Area, [left, right]: [&str; 2]) {
    let y = inner.low.y + inner.size.y + 3.0;
    canvas.text(DVec2::new(inner.low.x, y), 1, INK, left);
    canvas.text(DVec2::new(inner.low.x + inner.size.x - text_width(right, 1), y), 1, INK, right);
}
