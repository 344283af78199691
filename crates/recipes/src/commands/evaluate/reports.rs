//! Where the reports of an evaluation go.

use std::path::Path;

use image::RgbImage;

use crate::evaluate::{Report, write_file};
use crate::sheet::save_picture;

/// What one dataset or pair of sides came to.
pub(super) struct Evaluated {
    pub report: Report,
    /// Drawn when there is a folder for it.
    pub picture: Option<RgbImage>,
}

/// `report.json`, `report.md` and `report.png`; with several datasets in a folder each, and all of them together above.
pub(super) fn write_reports(out: Option<&Path>, all: &[Evaluated]) -> anyhow::Result<()> {
    let Some(out) = out else { return Ok(()) };
    let write = |folder: &Path, json: String, markdown: String| {
        write_file(&folder.join("report.json"), json.as_bytes())?;
        write_file(&folder.join("report.md"), markdown.as_bytes())
    };
    for (number, Evaluated { report, picture }) in all.iter().enumerate() {
        let folder = if all.len() == 1 { out.to_owned() } else { out.join(number.to_string()) };
        write(&folder, serde_json::to_string_pretty(report)?, report.markdown())?;
        if let Some(picture) = picture {
            save_picture(picture, &folder.join("report.png"))?;
        }
    }
    if all.len() < 2 {
        return Ok(());
    }
    let reports: Vec<&Report> = all.iter().map(|one| &one.report).collect();
    let pages: Vec<String> = reports.iter().map(|report| report.markdown()).collect();
    write(out, serde_json::to_string_pretty(&serde_json::json!({ "datasets": reports }))?, pages.join("\n"))
}
