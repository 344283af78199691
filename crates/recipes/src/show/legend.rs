//! The strip below the pictures: which frame it is and what the colours mean.

use std::collections::{BTreeMap, BTreeSet};

use data::{MapKind, OccupancyGrid};
use geometry::glam::DVec2;

use super::canvas::{Canvas, Color, line_height, text_width};
use super::{PageContent, colors};

/// One line of the strip: entries with a coloured square, or plain text.
type Entry = (Option<Color>, String);

/// The strip for a page of this width.
pub(super) fn draw(content: &PageContent, width: u32, scale: u32) -> Canvas {
    let rows: Vec<Vec<Entry>> = entries(content).into_iter().flat_map(|row| wrap(row, width, scale)).collect();
    let height = rows.len() as u32 * line_height(scale) + 4 * scale;
    let mut canvas = Canvas::new(width, height, colors::PAPER);
    for (row, entries) in rows.iter().enumerate() {
        let mut at = DVec2::new(f64::from(4 * scale), f64::from(row as u32 * line_height(scale) + 4 * scale));
        for (color, text) in entries {
            if let Some(color) = color {
                let side = f64::from(8 * scale);
                canvas.rectangle(at, DVec2::splat(side), *color, 1.0);
                at.x += 1.5 * side;
            }
            at.x = canvas.text(at, scale, colors::INK, text) + f64::from(16 * scale);
        }
    }
    canvas
}

fn entries(content: &PageContent) -> Vec<Vec<Entry>> {
    let frame = &content.frame;
    let id = &frame.id;
    let stamp = format!("{:.6} s", frame.timestamp_ns as f64 * 1e-9);
    let mut title = vec![format!("{} / {} / {}", id.dataset, id.scene, id.frame), stamp];
    if !content.lacking.is_empty() {
        title.push(format!("without {}", content.lacking.join(", ")));
    }
    let mut rows = vec![title.into_iter().map(|text| (None, text)).collect::<Vec<Entry>>()];
    rows.extend(frame.scene_text.as_ref().map(|text| vec![(None, text.clone())]));
    rows.push(class_entries(content));
    rows.push(map_entries(content));
    rows.extend(content.occupancy.as_ref().map(label_entries));
    rows.retain(|row| !row.is_empty());
    rows
}

fn class_entries(content: &PageContent) -> Vec<Entry> {
    let mut counts = BTreeMap::new();
    for object in content.frame.boxes.iter().flatten() {
        *counts.entry(object.class).or_insert(0usize) += 1;
    }
    counts
        .into_iter()
        .map(|(class, count)| (Some(colors::of_class(class)), format!("{} {count}", class.name())))
        .collect()
}

fn map_entries(content: &PageContent) -> Vec<Entry> {
    let mut seen = BTreeSet::new();
    let lines = content.map.lines.iter().map(|line| line.kind);
    let areas = content.map.areas.iter().map(|area| area.kind).filter(|kind| *kind != MapKind::Boundary);
    let mut entries = Vec::new();
    for kind in lines.chain(areas) {
        if seen.insert(colors::map_name(kind)) {
            entries.push((Some(colors::of_map(kind)), colors::map_name(kind).to_owned()));
        }
    }
    entries
}

fn label_entries(grid: &OccupancyGrid) -> Vec<Entry> {
    let present: BTreeSet<u8> = grid.labels.iter().copied().collect();
    let shown = present.into_iter().filter(|label| *label != grid.free() && *label != OccupancyGrid::IGNORED);
    let entry = |label| {
        let color = colors::of_label(grid.label_set, label);
        (Some(color), colors::label_name(grid.label_set, label).to_owned())
    };
    shown.map(entry).collect()
}

/// Breaks a row where it would leave the page; long texts between words.
fn wrap(row: Vec<Entry>, width: u32, scale: u32) -> Vec<Vec<Entry>> {
    let room = f64::from(width) - f64::from(8 * scale);
    let letters = (room / text_width("m", scale)) as usize;
    let mut rows: Vec<Vec<Entry>> = vec![Vec::new()];
    let mut used = 0.0;
    for (color, text) in row {
        for part in pieces(&text, letters.max(1)) {
            let needed = text_width(&part, scale) + f64::from(28 * scale);
            if used + needed > room + f64::from(28 * scale) && used > 0.0 {
                rows.push(Vec::new());
                used = 0.0;
            }
            used += needed;
            if let Some(last) = rows.last_mut() {
                last.push((color, part));
            }
        }
    }
    rows
}

/// Parts of at most this many letters, split at spaces; a single longer word stays whole.
fn pieces(text: &str, letters: usize) -> Vec<String> {
    let mut pieces = vec![String::new()];
    for word in text.split_whitespace() {
        let Some(last) = pieces.last_mut() else { break };
        if last.is_empty() {
            *last = word.to_owned();
        } else if last.chars().count() + 1 + word.chars().count() <= letters {
            *last = format!("{last} {word}");
        } else {
            pieces.push(word.to_owned());
        }
    }
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_broken_between_words() {
        assert_eq!(pieces("one two  three", 7), ["one two", "three"]);
        assert_eq!(pieces("extraordinarily long", 4), ["extraordinarily", "long"]);
        let entry = |text: &str| (None, text.to_owned());
        let rows = wrap(vec![entry("aaaa"), entry("bbbb"), entry("cccc")], 150, 1);
        assert_eq!(rows.iter().map(Vec::len).collect::<Vec<_>>(), [2, 1]);
    }
}
