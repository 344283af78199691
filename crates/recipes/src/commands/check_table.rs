//! A check's findings as lines of text.

use data::check::{CameraReport, RigReport};
use data::{BatchMemory, CheckReport};

/// Everything about one dataset; at most `most` lines of each list.
pub(super) fn report(place: &str, report: &CheckReport, most: usize) -> Vec<String> {
    let mut lines = vec![format!("{place}: {}", report.name)];
    let mut row = |name: &str, value: String| lines.push(format!("  {name:<12} {value}"));
    row("frames", format!("{} in {}", report.frames, count(report.scenes, "scene")));
    row("pictures", pictures(report));
    row("boxes", boxes(report));
    row("parts", parts(report));
    row("times", times(report));
    for rig in &report.rigs {
        lines.extend(rig_lines(rig));
    }
    let gap = |gap: &data::check::Gap| format!("{} after frame {}: {:.3} s", gap.scene, gap.after_frame, gap.secs);
    list(&mut lines, "holes in time", report.times.gaps.iter().map(gap).collect(), most);
    list(&mut lines, "notes", report.notes.clone(), most);
    list(&mut lines, "odd", report.warnings.clone(), most);
    let text = |errors: &[data::DataError]| errors.iter().map(ToString::to_string).collect();
    list(&mut lines, "unreadable frames", text(&report.unreadable_frames), most);
    list(&mut lines, "missing or broken files", text(&report.problems), most);
    let verdict = if report.could_train() {
        "sound".to_owned()
    } else if report.is_sound() {
        "holds nothing to train on".to_owned()
    } else {
        format!(
            "not usable: {} unreadable frames, {} files missing, {} broken",
            report.unreadable_frames.len(),
            report.missing(),
            report.damaged()
        )
    };
    lines.push(format!("  {:<12} {verdict}", "verdict"));
    lines
}

/// What a batch takes on the host.
pub(super) fn memory(memory: &BatchMemory) -> Vec<String> {
    let size = memory.size;
    vec![format!(
        "host memory: {} for a batch of {} with {} views of {}x{}, about {} while loading",
        bytes(memory.batch_bytes),
        memory.batch_size,
        memory.views,
        size.width,
        size.height,
        bytes(memory.loader_bytes)
    )]
}

fn pictures(report: &CheckReport) -> String {
    let files = format!("{} files", report.pictures);
    let rendered = format!("{} rendered when asked for", report.rendered_views);
    let what = match (report.pictures, report.rendered_views) {
        (_, 0) => files,
        (0, _) => rendered,
        _ => format!("{files}, {rendered}"),
    };
    format!("{what}, {} decoded completely, {} views without a picture", report.decoded, report.absent_views)
}

fn boxes(report: &CheckReport) -> String {
    let boxes = &report.boxes;
    if boxes.annotated_frames == 0 {
        return "no frame is annotated".to_owned();
    }
    let mut classes: Vec<_> = boxes.by_class.iter().collect();
    classes.sort_by_key(|(class, count)| (std::cmp::Reverse(**count), **class));
    let classes: Vec<String> = classes.iter().map(|(class, count)| format!("{} {count}", class.name())).collect();
    format!(
        "{} in {}; {} interpolated, {} in no picture{}{}",
        boxes.count,
        count(boxes.annotated_frames, "annotated frame"),
        boxes.interpolated,
        boxes.outside_all_pictures,
        if classes.is_empty() { "" } else { "\n               " },
        classes.join(", ")
    )
}

fn parts(report: &CheckReport) -> String {
    let c = report.capabilities;
    let named = [
        (c.boxes, "boxes".to_owned()),
        (c.map, format!("map ({} read)", report.maps_read)),
        (c.occupancy, occupancy(report)),
        (c.can_bus, "CAN bus".to_owned()),
        (c.masks, "masks".to_owned()),
        (c.text, "text".to_owned()),
    ];
    let present: Vec<String> = named.into_iter().filter(|part| part.0).map(|part| part.1).collect();
    if present.is_empty() { "pictures only".to_owned() } else { present.join(", ") }
}

fn occupancy(report: &CheckReport) -> String {
    match report.occupancy_absent {
        0 => format!("occupancy ({} read)", report.occupancy_read),
        absent => format!("occupancy ({} read, {absent} frames without)", report.occupancy_read),
    }
}

fn times(report: &CheckReport) -> String {
    let times = &report.times;
    if times.longest_secs == 0.0 {
        return "no scene has two frames".to_owned();
    }
    format!(
        "{:.3} s between frames ({:.3} to {:.3}), pictures up to {:.0} ms and {:.2} m from their frame",
        times.median_secs,
        times.shortest_secs,
        times.longest_secs,
        times.longest_picture_offset_secs * 1e3,
        times.longest_picture_way_m
    )
}

fn rig_lines(rig: &RigReport) -> Vec<String> {
    let ring = if rig.closed { "closed ring" } else { "open chain" };
    let mut lines = vec![format!(
        "  {:<12} {}, {ring}; {} in {}, {}",
        "rig",
        count(rig.cameras.len(), "camera"),
        count(rig.frames, "frame"),
        count(rig.scenes, "scene"),
        count(rig.calibrations, "calibration")
    )];
    let width = rig.cameras.iter().map(|camera| camera.channel.len()).max().unwrap_or(0).max(7);
    lines.push(format!(
        "    {:<width$} {:>9} {:<14} {:>7} {:>7} {:>8} {:>6} {:>6} {:>8}  position x y z m",
        "camera", "size", "lens", "fx", "fy", "azimuth", "elev.", "hfov", "overlap"
    ));
    lines.extend(rig.cameras.iter().map(|camera| camera_line(camera, width)));
    lines
}

fn camera_line(camera: &CameraReport, width: usize) -> String {
    let [x, y, z] = camera.position_m;
    let overlap = camera.overlap_deg.map_or_else(|| "-".to_owned(), |overlap| format!("{overlap:.1}"));
    format!(
        "    {:<width$} {:>9} {:<14} {:>7.1} {:>7.1} {:>8.1} {:>6.1} {:>6.1} {overlap:>8}  {x:.2} {y:.2} {z:.2}",
        camera.channel,
        format!("{}x{}", camera.width, camera.height),
        camera.lens,
        camera.fx,
        camera.fy,
        camera.azimuth_deg,
        camera.elevation_deg,
        camera.hfov_deg
    )
}

fn count(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

fn list(lines: &mut Vec<String>, name: &str, entries: Vec<String>, most: usize) {
    if entries.is_empty() {
        return;
    }
    let count = entries.len();
    lines.push(format!("  {name} ({count})"));
    lines.extend(entries.into_iter().take(most).map(|entry| format!("    {entry}")));
    if count > most {
        lines.push(format!("    ... and {} more", count - most));
    }
}

fn bytes(count: usize) -> String {
    let mega = count as f64 / 1e6;
    if mega < 1000.0 { format!("{mega:.1} MB") } else { format!("{:.2} GB", mega * 1e-3) }
}
