//! The report as a table.

use std::fmt::Write;

use super::Report;

impl Report {
    /// A table and the notes.
    pub fn markdown(&self) -> String {
        let mut text = String::from("# Evaluation\n\n");
        let mut line = |line: String| {
            text.push_str(&line);
            text.push('\n');
        };
        line(format!("Measured: {}  ", self.generated));
        line(format!("Against: {}  ", self.real));
        let size =
            self.size.map_or(String::new(), |[height, width]| format!(", all brought to {height}x{width} first"));
        line(format!(
            "{} frames, {} pictures{size}; seed {}; {:.1} s; {}  ",
            self.frames, self.pictures, self.seed, self.wall_seconds, self.code
        ));
        for (key, value) in &self.model {
            line(format!("{key}: {value}  "));
        }
        for (reason, count) in &self.skipped {
            line(format!("did not count: {count} {reason}  "));
        }
        line(
            "\n| metric | value | deviation | better | samples | protocol | weights |\n|---|---|---|---|---|---|---|"
                .to_owned(),
        );
        for one in &self.metrics {
            let number = |value: Option<f64>| value.map_or("-".to_owned(), rounded);
            let unit = if one.unit == "1" { String::new() } else { format!(" {}", one.unit) };
            let weights = one.weights.as_ref().map_or("-".to_owned(), |weights| {
                format!("{} {}", weights.file, weights.sha256.get(..12).unwrap_or_default())
            });
            let better = if one.higher_is_better { "higher" } else { "lower" };
            let (value, deviation) = (number(one.value), number(one.deviation));
            line(format!(
                "| {} | {value}{unit} | {deviation} | {better} | {} | {} | {weights} |",
                one.name, one.samples, one.protocol
            ));
        }
        text.push_str(&self.novel_view_table());
        text.push_str(&self.camera_table());
        let mut notes = String::new();
        for one in &self.metrics {
            for note in &one.notes {
                // Writing to a string cannot fail.
                let _ = writeln!(notes, "- {} ({}): {note}", one.name, one.protocol);
            }
        }
        if !notes.is_empty() {
            text.push_str("\n## Notes\n\n");
            text.push_str(&notes);
        }
        text
    }
}

impl Report {
    fn novel_view_table(&self) -> String {
        if self.novel_views.is_empty() {
            return String::new();
        }
        let head = "\n## Views that no camera took, against their rendering (nvs/toy)\n\n| rig | PSNR | SSIM | pictures |\n|---|---|---|---|\n";
        self.novel_views.iter().fold(head.to_owned(), |text, one| {
            let number = |value: Option<f64>| value.map_or("-".to_owned(), rounded);
            let (db, ssim) = (number(one.psnr.mean_db), number(one.ssim));
            text + &format!("| {} | {db} dB | {ssim} | {} |\n", one.motion, one.psnr.images)
        })
    }

    /// A row per camera, a column per metric of pairs.
    fn camera_table(&self) -> String {
        let columns: Vec<_> = self.metrics.iter().filter(|one| !one.cameras.is_empty()).collect();
        let cameras: std::collections::BTreeSet<&String> = columns.iter().flat_map(|one| one.cameras.keys()).collect();
        if cameras.is_empty() {
            return String::new();
        }
        let titles: Vec<String> = columns.iter().map(|one| format!("{} ({})", one.name, one.protocol)).collect();
        let head =
            format!("\n## Per camera\n\n| camera | {} |\n|---|{}\n", titles.join(" | "), "---|".repeat(titles.len()));
        cameras.into_iter().fold(head, |text, camera| {
            let value =
                |one: &&super::MetricReport| one.cameras.get(camera).copied().flatten().map_or("-".to_owned(), rounded);
            let values: Vec<String> = columns.iter().map(value).collect();
            text + &format!("| {camera} | {} |\n", values.join(" | "))
        })
    }
}

/// As many digits as papers print; the JSON file has all of them.
fn rounded(value: f64) -> String {
    match value.abs() {
        size if size >= 10.0 => format!("{value:.2}"),
        size if size >= 0.01 || size == 0.0 => format!("{value:.4}"),
        _ => format!("{value:.3e}"),
    }
}
