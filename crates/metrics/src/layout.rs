//! Does a generated picture show the layout it was asked for?

use serde::{Deserialize, Serialize};

use crate::{ExactSum, Overlap, Pixel};

/// Pixels whose true class is unknown.
pub const UNKNOWN_CLASS: u8 = 255;

/// `layout_iou/toy`: pixels are classified by the nearest colour of a palette and compared with the rendered class mask. Sound only
/// for worlds whose classes differ in colour.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LayoutIou {
    palette: Vec<[f64; 3]>,
    overlaps: Vec<Overlap>,
}

impl LayoutIou {
    /// One colour per class, RGB in [0, 1].
    #[must_use]
    pub fn new(palette: &[[f64; 3]]) -> Self {
        Self { palette: palette.to_vec(), overlaps: vec![Overlap::default(); palette.len()] }
    }

    /// Adds a picture.
    ///
    /// # Shapes
    /// - image: `[3, H, W]`, RGB in [0, 1]
    /// - classes: `[H, W]`, places in the palette or [`UNKNOWN_CLASS`]
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn update(&mut self, image: &[f32], classes: &[u8]) {
        assert_eq!(image.len(), 3 * classes.len(), "values of a picture of {} pixels", classes.len());
        let plane = classes.len();
        for (at, truth) in classes.iter().enumerate().filter(|(_, class)| **class != UNKNOWN_CLASS) {
            let color = [0, 1, 2].map(|channel| image[channel * plane + at].displayed());
            let found = self.nearest(color);
            for (class, overlap) in self.overlaps.iter_mut().enumerate() {
                overlap.add(found == Some(class), usize::from(*truth) == class);
            }
        }
    }

    fn nearest(&self, color: [f64; 3]) -> Option<usize> {
        let apart = |other: &[f64; 3]| color.iter().zip(other).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        (0..self.palette.len()).min_by(|a, b| apart(&self.palette[*a]).total_cmp(&apart(&self.palette[*b])))
    }

    /// Adds the pictures of another collector.
    ///
    /// # Panics
    /// When the palettes differ.
    pub fn merge(&mut self, other: &Self) {
        assert_eq!(self.palette, other.palette, "palettes");
        self.overlaps.iter_mut().zip(&other.overlaps).for_each(|(a, b)| a.merge(b));
    }

    /// IoU of each class; `None` for a class that neither side shows.
    #[must_use]
    pub fn per_class(&self) -> Vec<Option<f64>> {
        self.overlaps.iter().map(Overlap::iou).collect()
    }
}

/// Edit locality: how much pixels change where a layout was edited, over how much they change elsewhere, with the noise held fixed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct EditLocality {
    inside: ExactSum,
    outside: ExactSum,
    values_inside: u64,
    values_outside: u64,
}

impl EditLocality {
    /// Adds a picture before and after the edit.
    ///
    /// # Shapes
    /// - before, after: `[3, H, W]`, RGB in [0, 1]
    /// - edited: `[H, W]`, true inside the dilated projection of the edited boxes
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn update(&mut self, before: &[f32], after: &[f32], edited: &[bool]) {
        assert_eq!(before.len(), after.len(), "values before and after");
        assert_eq!(before.len(), 3 * edited.len(), "values of a picture of {} pixels", edited.len());
        for ((before, after), edited) in before.iter().zip(after).zip(edited.iter().cycle()) {
            let change = (after.displayed() - before.displayed()).abs();
            let (sum, count) = if *edited {
                (&mut self.inside, &mut self.values_inside)
            } else {
                (&mut self.outside, &mut self.values_outside)
            };
            sum.add(change);
            *count += 1;
        }
    }

    /// Adds the pictures of another collector.
    pub fn merge(&mut self, other: &Self) {
        self.inside.merge(&other.inside);
        self.outside.merge(&other.outside);
        self.values_inside += other.values_inside;
        self.values_outside += other.values_outside;
    }

    /// Mean absolute change inside and outside, in [0, 1]; `None` where there is no such pixel.
    #[must_use]
    pub fn changes(&self) -> (Option<f64>, Option<f64>) {
        let mean = |sum: &ExactSum, count: u64| (count > 0).then(|| sum.value() / count as f64);
        (mean(&self.inside, self.values_inside), mean(&self.outside, self.values_outside))
    }

    /// Inside over outside, infinite for an edit that touches nothing else; `None` without pixels on a side or without any change.
    #[must_use]
    pub fn ratio(&self) -> Option<f64> {
        let (inside, outside) = self.changes();
        let ratio = inside? / outside?;
        (!ratio.is_nan()).then_some(ratio)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_take_the_class_of_the_nearest_colour() {
        let mut iou = LayoutIou::new(&[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]);
        // Reddish, blue, reddish, black; the last is unknown.
        let image = [0.9, 0.1, 0.6, 0.0, 0.1, 0.0, 0.2, 0.0, 0.0, 0.8, 0.3, 0.0];
        iou.update(&image, &[0, 1, 1, UNKNOWN_CLASS]);
        assert_eq!(iou.per_class(), [Some(0.5), Some(0.5), None]);
        let mut twice = iou.clone();
        twice.merge(&iou);
        assert_eq!(twice.per_class(), iou.per_class());
    }

    #[test]
    fn change_is_compared_with_its_surroundings() {
        let mut edit = EditLocality::default();
        assert_eq!(edit.ratio(), None);
        let after = [0.5, 0.1, 0.5, 0.1, 0.5, 0.1];
        edit.update(&[0.0; 6], &after, &[true, false]);
        assert!((edit.ratio().unwrap() - 5.0).abs() < 1e-6);
        edit.merge(&edit.clone());
        assert!((edit.ratio().unwrap() - 5.0).abs() < 1e-6);
        let mut local = EditLocality::default();
        local.update(&[0.0; 6], &[0.5, 0.0, 0.5, 0.0, 0.5, 0.0], &[true, false]);
        assert_eq!(local.ratio(), Some(f64::INFINITY));
    }
}
