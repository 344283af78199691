//! The evaluation as a picture: numbers, how the values spread, and the worst pairs side by side.

use geometry::glam::DVec2;
use image::RgbImage;
use image::imageops::{FilterType, resize};
use metrics::Raster;

use super::chart::{Area, Curve, INK, PAPER, bars, curves, legend_height, short};
use super::report::Report;
use super::scalar::ScalarMetric;
use super::source::PictureSource;
use crate::show::canvas::{Canvas, line_height};

/// Width of the page, px.
const WIDTH: u32 = 1240;
/// Around everything, px.
const MARGIN: f64 = 20.0;
/// Of a histogram, px.
const CHART: DVec2 = DVec2::new(380.0, 150.0);
/// Of a picture among the worst, px.
const THUMB: (u32, u32) = (196, 130);
/// Charts in a row.
const COLUMNS: usize = 3;
/// Pairs of pictures in a row.
const PAIRS: usize = 3;

/// Draws the page. `sides` are read again for the worst pairs; without them only numbers and distributions are drawn.
///
/// # Errors
/// Whatever reading the worst pictures reports.
pub fn draw_report(
    report: &Report,
    scalars: &[ScalarMetric],
    sides: Option<(&dyn PictureSource, &dyn PictureSource)>,
) -> anyhow::Result<RgbImage> {
    let pairs = worst_pairs(scalars, sides)?;
    let line = f64::from(line_height(1));
    let text_rows = report.metrics.len() as f64 + 5.0;
    let chart_rows = scalars.len().div_ceil(COLUMNS) as f64;
    let pair_rows: f64 = pairs.iter().map(|(_, pairs)| pairs.len().div_ceil(PAIRS) as f64).sum();
    let chart_height = CHART.y + 2.0 * line + 12.0;
    let pair_height = f64::from(THUMB.1) + line + 8.0;
    let height = 2.0 * MARGIN
        + text_rows * line
        + chart_rows * chart_height
        + pair_rows * pair_height
        + pairs.len() as f64 * (line + 6.0);
    let mut canvas = Canvas::new(WIDTH, height.ceil() as u32, PAPER);
    let mut at = DVec2::splat(MARGIN);
    write_numbers(&mut canvas, &mut at, report, line);
    for (place, scalar) in scalars.iter().enumerate() {
        let column = (place % COLUMNS) as f64 * (CHART.x + 20.0);
        let row = (place / COLUMNS) as f64 * chart_height;
        let area = Area { low: at + DVec2::new(column, row), size: CHART };
        let count = scalar.mean.count();
        let title = format!("{}, {count} pictures, line: mean", scalar.protocol.name);
        bars(&mut canvas, area, &title, &scalar.histogram, scalar.mean.mean());
    }
    at.y += chart_rows * chart_height;
    for (name, pairs) in &pairs {
        canvas.text(at, 1, INK, &format!("Worst by {name}: real left, generated right"));
        at.y += line + 6.0;
        for row in pairs.chunks(PAIRS) {
            for (column, pair) in row.iter().enumerate() {
                let x = at.x + column as f64 * (2.0 * f64::from(THUMB.0) + 12.0);
                canvas.paste(&pair.real, x as u32, at.y as u32);
                canvas.paste(&pair.generated, x as u32 + THUMB.0 + 2, at.y as u32);
                canvas.text(DVec2::new(x, at.y + f64::from(THUMB.1) + 3.0), 1, INK, &pair.label);
            }
            at.y += pair_height;
        }
    }
    Ok(canvas.picture)
}

fn write_numbers(canvas: &mut Canvas, at: &mut DVec2, report: &Report, line: f64) {
    let mut write = |text: String| {
        // Long lines would leave the page.
        let most = (f64::from(WIDTH) - 2.0 * MARGIN) as usize / 8;
        canvas.text(*at, 1, INK, &text.chars().take(most).collect::<String>());
        at.y += line;
    };
    write(format!("Measured: {}", report.generated));
    write(format!("Against:  {}", report.real));
    write(format!("{} frames, {} pictures, seed {}, {}", report.frames, report.pictures, report.seed, report.code));
    write(String::new());
    for one in &report.metrics {
        let value = one.value.map_or("-".to_owned(), short);
        let deviation = one.deviation.map_or(String::new(), |deviation| format!(" +- {}", short(deviation)));
        let stand_in = if one.is_proxy { "  (stand-in network)" } else { "" };
        let name = &one.name;
        write(format!("{name:<28} {value}{deviation}   {} samples, {}{stand_in}", one.samples, one.protocol));
    }
    write(String::new());
}

struct WorstPair {
    real: RgbImage,
    generated: RgbImage,
    label: String,
}

fn worst_pairs(
    scalars: &[ScalarMetric],
    sides: Option<(&dyn PictureSource, &dyn PictureSource)>,
) -> anyhow::Result<Vec<(String, Vec<WorstPair>)>> {
    let Some((real, generated)) = sides else { return Ok(Vec::new()) };
    let mut all = Vec::new();
    for scalar in scalars {
        let mut pairs = Vec::new();
        for ranked in scalar.worst.samples() {
            let Some((index, channel)) = ranked.name.split_once(':') else { continue };
            let Ok(index) = index.parse::<usize>() else { continue };
            let picture = |source: &dyn PictureSource| -> anyhow::Result<Option<RgbImage>> {
                let instant = source.instant(index)?;
                Ok(instant.views.iter().find(|shot| shot.channel == channel).and_then(|shot| thumb(&shot.picture)))
            };
            if let (Some(real), Some(painted)) = (picture(real)?, picture(generated)?) {
                let label = format!("{}  {} {channel}", short(ranked.value), generated.name(index)?);
                let label = label.chars().take((2 * THUMB.0 / 8) as usize).collect();
                pairs.push(WorstPair { real, generated: painted, label });
            }
        }
        if !pairs.is_empty() {
            all.push((scalar.protocol.name.clone(), pairs));
        }
    }
    Ok(all)
}

/// Fits a picture into a thumbnail; the rest is paper.
fn thumb(picture: &Raster<u8>) -> Option<RgbImage> {
    let full = RgbImage::from_raw(picture.width as u32, picture.height as u32, picture.pixels.clone())?;
    let factor = (f64::from(THUMB.0) / f64::from(full.width())).min(f64::from(THUMB.1) / f64::from(full.height()));
    let side = |side: u32| ((f64::from(side) * factor) as u32).max(1);
    let small = resize(&full, side(full.width()), side(full.height()), FilterType::Triangle);
    let mut framed = RgbImage::from_pixel(THUMB.0, THUMB.1, image::Rgb(PAPER));
    image::imageops::replace(&mut framed, &small, 0, 0);
    Some(framed)
}

/// Charts of curves beneath each other in two columns, every curve scaled to its own range.
pub fn draw_curves(title: &str, charts: &[(String, Vec<Curve>)]) -> RgbImage {
    let line = f64::from(line_height(1));
    let size = DVec2::new(560.0, 220.0);
    let most = charts.iter().map(|(_, curves)| curves.len()).max().unwrap_or(0);
    let row_height = size.y + legend_height(most) + 20.0;
    let rows = charts.len().div_ceil(2) as f64;
    let mut canvas = Canvas::new(WIDTH, (2.0 * MARGIN + 2.0 * line + rows * row_height).ceil() as u32, PAPER);
    canvas.text(DVec2::splat(MARGIN), 1, INK, title);
    for (place, (name, of_chart)) in charts.iter().enumerate() {
        let corner = DVec2::new((place % 2) as f64 * (size.x + 60.0), (place / 2) as f64 * row_height + 2.0 * line);
        curves(&mut canvas, Area { low: corner + MARGIN, size }, name, of_chart);
    }
    canvas.picture
}
