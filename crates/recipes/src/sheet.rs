//! Contact sheets: rows of equally sized pictures.

use std::path::Path;

use anyhow::Context;
use image::{Rgb, RgbImage};

/// Pixels between pictures.
const GAP: u32 = 2;

/// A grid of pictures; rows may have different lengths.
#[derive(Debug, Clone)]
pub struct Sheet {
    height: u32,
    width: u32,
    rows: Vec<Vec<RgbImage>>,
}

impl Sheet {
    /// An empty sheet for pictures of this size.
    pub fn new(height: usize, width: usize) -> Self {
        Self { height: height as u32, width: width as u32, rows: Vec::new() }
    }

    /// Adds a row of `[3, H, W]` pictures in [0, 1].
    pub fn row<'a>(&mut self, pictures: impl IntoIterator<Item = &'a [f32]>) {
        let (h, w) = (self.height, self.width);
        self.rows.push(pictures.into_iter().map(|values| rgb_image(values, h, w)).collect());
    }

    /// Adds a row of pictures of the sheet's size.
    pub fn row_of(&mut self, pictures: Vec<RgbImage>) {
        self.rows.push(pictures);
    }

    /// Adds a thin empty row.
    pub fn space(&mut self) {
        self.rows.push(Vec::new());
    }

    /// The whole sheet as one picture.
    pub fn picture(&self) -> RgbImage {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
        let row_height = |row: &Vec<RgbImage>| if row.is_empty() { 2 * GAP } else { self.height + GAP };
        let height = GAP + self.rows.iter().map(row_height).sum::<u32>();
        let mut sheet = RgbImage::from_pixel(GAP + columns * (self.width + GAP), height, Rgb([24, 24, 24]));
        let mut y = GAP;
        for row in &self.rows {
            for (column, picture) in row.iter().enumerate() {
                let x = GAP + column as u32 * (self.width + GAP);
                image::imageops::replace(&mut sheet, picture, i64::from(x), i64::from(y));
            }
            y += row_height(row);
        }
        sheet
    }

    /// Writes the sheet; the file's ending chooses PNG or JPEG.
    ///
    /// # Errors
    /// Names the file.
    pub fn save(&self, path: &Path) -> anyhow::Result<()> {
        save_picture(&self.picture(), path)
    }
}

/// Writes a picture beside its final name, then renames it, so that no reader meets half a file.
///
/// # Errors
/// Names the file.
pub fn save_picture(picture: &RgbImage, path: &Path) -> anyhow::Result<()> {
    let format = image::ImageFormat::from_path(path)
        .with_context(|| format!("{} needs the ending .png or .jpg", path.display()))?;
    if let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(parent).with_context(|| format!("cannot make the folder {}", parent.display()))?;
    }
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    picture.save_with_format(&part, format).with_context(|| format!("cannot write {}", part.display()))?;
    std::fs::rename(&part, path).with_context(|| format!("cannot write {}", path.display()))
}

/// `[3, H, W]` in [0, 1] to 8 bits.
pub fn rgb_image(values: &[f32], height: u32, width: u32) -> RgbImage {
    let plane = (height * width) as usize;
    RgbImage::from_fn(width, height, |x, y| {
        let at = (y * width + x) as usize;
        Rgb([0, 1, 2].map(|c| (values[c * plane + at].clamp(0.0, 1.0) * 255.0).round() as u8))
    })
}
