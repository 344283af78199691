//! One camera's picture with everything drawn into it.

use anyhow::{Context, bail};
use data::{LocalMap, ObjectBox};
use geometry::ImageEdit;
use geometry::glam::{DVec2, DVec3};

use super::canvas::{Canvas, text_width};
use super::objects::{Cell, Wires, far_first};
use super::project::Projector;
use super::{PageContent, colors};

/// The map fades out at this distance, metres; further lines are a smear at the horizon.
const MAP_FAR_M: f64 = 60.0;
/// Boxes nearer than this have full lines, metres; further ones thinner.
const BOX_NEAR_M: f64 = 25.0;
/// How strongly cells cover the picture.
const CELL_AMOUNT: f64 = 0.5;
/// Smallest cell that is drawn as more than a dot, px.
const DOT_PX: f64 = 1.5;

/// The drawn view with this place in the frame. `cells` are drawn too where they are given.
///
/// # Errors
/// Pictures that cannot be read, naming the file; calibration that cannot be used.
pub(super) fn draw(
    content: &PageContent,
    number: usize,
    size: (u32, u32),
    scale: u32,
    cells: Option<(&[Cell], f64)>,
) -> anyhow::Result<Canvas> {
    let Some(view) = content.frame.views.get(number) else { bail!("the frame has no view {number}") };
    let (width, height) = size;
    let edit = ImageEdit::identity(view.intrinsics.width, view.intrinsics.height).resize(width, height);
    let mut canvas = Canvas::new(width, height, [48, 48, 52]);
    if let Some(image) = &view.image {
        canvas.picture = image.load(&edit)?;
    }
    if let Some(mask) = &view.mask {
        let mask = mask.load(&edit)?;
        let ignored = mask.enumerate_pixels().filter(|(_, _, pixel)| pixel.0.iter().all(|value| *value < 128));
        ignored.for_each(|(x, y, _)| canvas.blend(i64::from(x), i64::from(y), colors::IGNORED, 0.35));
    }
    let drawn_px = canvas.size();
    let projector = Projector::new(view, &content.frame.world_from_ego, drawn_px)
        .with_context(|| format!("camera {}", view.channel))?;
    if let Some((cells, side_m)) = cells {
        draw_cells(&mut canvas, &projector, cells, side_m);
    }
    draw_map(&mut canvas, &projector, &content.map, scale);
    for object in far_first(content.frame.boxes.as_deref().unwrap_or_default(), projector.center()) {
        draw_box(&mut canvas, &projector, object, scale);
    }
    let offset_ms = (view.timestamp_ns - content.frame.timestamp_ns) as f64 * 1e-6;
    let absent = if view.image.is_none() { "  no picture" } else { "" };
    let text = format!("{} {} {offset_ms:+.1} ms{absent}", number + 1, view.channel);
    let fits = text_width(&text, scale) + f64::from(4 * scale) <= drawn_px.x;
    canvas.label(DVec2::ZERO, if fits { scale } else { 1 }, colors::INK, &text);
    Ok(canvas)
}

fn draw_map(canvas: &mut Canvas, projector: &Projector, map: &LocalMap, scale: u32) {
    let eye = projector.center();
    for line in &map.lines {
        let points: Vec<DVec3> = line.points.iter().map(|point| DVec3::from_array(*point)).collect();
        let width = if line.kind == data::MapKind::Centerline { 0.6 } else { 1.2 } * f64::from(scale);
        for near in points.chunk_by(|a, b| a.distance(eye).min(b.distance(eye)) < MAP_FAR_M) {
            for part in projector.line(near) {
                canvas.polyline(&part, colors::of_map(line.kind), width);
            }
        }
    }
}

/// The front face is tinted and thick, so that the heading shows.
fn draw_box(canvas: &mut Canvas, projector: &Projector, object: &ObjectBox, scale: u32) {
    let color = colors::of_class(object.class);
    let wires = Wires::of(object);
    let near = (BOX_NEAR_M / object.box3d.center.distance(projector.center()).max(1.0)).clamp(0.4, 1.0);
    let thin = 0.75 * near * f64::from(scale);
    for wire in &wires.others {
        projector.line(wire).iter().for_each(|part| canvas.polyline(part, color, thin));
    }
    let front = projector.line(&wires.front);
    let is_whole = wires.front.iter().all(|corner| projector.point(*corner).is_some());
    if let ([ring], true) = (front.as_slice(), is_whole) {
        canvas.fill(std::slice::from_ref(ring), color, 0.3);
    }
    front.iter().for_each(|part| canvas.polyline(part, color, 2.0 * thin));
}

/// Far cells first, each as large as it looks at its distance; all of them are laid over the picture at once.
fn draw_cells(canvas: &mut Canvas, projector: &Projector, cells: &[Cell], side_m: f64) {
    let eye = projector.center();
    let mut seen: Vec<(f64, DVec2, &Cell)> = cells
        .iter()
        .filter_map(|cell| Some((cell.center.distance(eye), projector.point(cell.center)?, cell)))
        .filter(|(_, pixel, _)| pixel.cmpgt(DVec2::splat(-50.0)).all() && pixel.cmplt(canvas.size() + 50.0).all())
        .collect();
    seen.sort_by(|a, b| b.0.total_cmp(&a.0));
    let bare = canvas.picture.clone();
    for (_, pixel, cell) in seen {
        let above = projector.point(cell.center + DVec3::new(0.0, 0.0, side_m));
        let side = above.map_or(DOT_PX, |above| above.distance(pixel)).max(DOT_PX);
        canvas.rectangle(pixel - 0.5 * side, DVec2::splat(side), cell.color, 1.0);
    }
    for (covered, bare) in canvas.picture.pixels_mut().zip(bare.pixels()) {
        for (covered, bare) in covered.0.iter_mut().zip(bare.0) {
            *covered = (CELL_AMOUNT * f64::from(*covered) + (1.0 - CELL_AMOUNT) * f64::from(bare)).round() as u8;
        }
    }
}
