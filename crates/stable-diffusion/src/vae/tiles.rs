//! Decoding a large latent in overlapping tiles whose pictures are blended.

use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, positive};

/// Size and overlap of tiles, in latent cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, try_from = "Raw", into = "Raw")]
pub struct Tiling {
    size: usize,
    overlap: usize,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "Tiling")]
struct Raw {
    size: usize,
    overlap: usize,
}

impl TryFrom<Raw> for Tiling {
    type Error = ConfigError;

    fn try_from(raw: Raw) -> Result<Self, ConfigError> {
        Self::new(raw.size, raw.overlap)
    }
}

impl From<Tiling> for Raw {
    fn from(tiling: Tiling) -> Self {
        Self { size: tiling.size, overlap: tiling.overlap }
    }
}

impl Tiling {
    /// Tiles of `size`² cells of which neighbours share at least `overlap`.
    ///
    /// # Errors
    /// [`ConfigError`] when the size is 0 or the overlap is more than half of it.
    pub fn new(size: usize, overlap: usize) -> Result<Self, ConfigError> {
        positive("tile size", size)?;
        if 2 * overlap > size {
            let reason = format!("{overlap} cells are more than half of a tile of {size}");
            return Err(ConfigError::Range { what: "tile overlap".to_owned(), reason });
        }
        Ok(Self { size, overlap })
    }

    /// # Shapes
    /// - latents: `[N, latent, h, w]`
    /// - output: `[N, C, h·f, w·f]`
    pub(super) fn decode(
        &self,
        latents: Tensor<4>,
        factor: usize,
        decode: impl Fn(Tensor<4>) -> Tensor<4>,
    ) -> Tensor<4> {
        let [n, _, h, w] = latents.dims();
        let (rows, columns) = (self.axis(h, factor), self.axis(w, factor));
        if rows.len() * columns.len() == 1 {
            return decode(latents);
        }
        let device = latents.device();
        let mut painted: Option<Tensor<4>> = None;
        for row in &rows {
            for column in &columns {
                let tile = latents.clone().narrow(2, row.start, row.length).narrow(3, column.start, column.length);
                let picture = decode(tile);
                let c = picture.dims()[1];
                let weights = |axis: &Tile, shape: [usize; 4]| {
                    Tensor::<4>::from_data(TensorData::new(axis.weights.clone(), shape), &device)
                };
                let y = weights(row, [1, 1, row.weights.len(), 1]);
                let x = weights(column, [1, 1, 1, column.weights.len()]);
                let canvas = painted.unwrap_or_else(|| Tensor::zeros([n, c, h * factor, w * factor], &device));
                let place = [0..n, 0..c, row.pixels(factor), column.pixels(factor)];
                let sum = canvas.clone().slice(place.clone()) + picture * y * x;
                painted = Some(canvas.slice_assign(place, sum));
            }
        }
        painted.unwrap_or_else(|| decode(latents))
    }

    /// Tiles along one axis of `cells`, equally long, the last one moved back so that it ends with the axis.
    fn axis(&self, cells: usize, factor: usize) -> Vec<Tile> {
        let length = self.size.min(cells);
        let stride = self.size - self.overlap;
        let last = cells - length;
        let mut starts: Vec<usize> = (0..last).step_by(stride).collect();
        starts.push(last);
        let mut tiles: Vec<Tile> = starts
            .into_iter()
            .map(|start| Tile { start, length, weights: self.ramp(start, length, cells, factor) })
            .collect();
        normalise(&mut tiles, cells * factor, factor);
        tiles
    }

    /// Weight of each pixel of a tile: 1, falling linearly over the overlap towards edges that are not the picture's.
    fn ramp(&self, start: usize, length: usize, cells: usize, factor: usize) -> Vec<f32> {
        let (pixels, overlap) = (length * factor, (self.overlap * factor) as f32);
        let rise = |distance: usize| ((distance as f32 + 0.5) / overlap).min(1.0);
        let weight = |p: usize| {
            let left = if start == 0 || self.overlap == 0 { 1.0 } else { rise(p) };
            let right = if start + length == cells || self.overlap == 0 { 1.0 } else { rise(pixels - 1 - p) };
            left * right
        };
        (0..pixels).map(weight).collect()
    }
}

/// A tile along one axis.
#[derive(Debug)]
struct Tile {
    /// First latent cell.
    start: usize,
    /// Latent cells.
    length: usize,
    /// Share of this tile in each of its pixels.
    weights: Vec<f32>,
}

impl Tile {
    fn pixels(&self, factor: usize) -> std::ops::Range<usize> {
        self.start * factor..(self.start + self.length) * factor
    }
}

/// Makes the weights of each pixel add up to 1.
fn normalise(tiles: &mut [Tile], pixels: usize, factor: usize) {
    let mut total = vec![0.0; pixels];
    for tile in tiles.iter() {
        for (total, weight) in total[tile.pixels(factor)].iter_mut().zip(&tile.weights) {
            *total += weight;
        }
    }
    for tile in tiles.iter_mut() {
        let range = tile.pixels(factor);
        for (weight, total) in tile.weights.iter_mut().zip(&total[range]) {
            *weight /= total;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_of_every_pixel_add_up_to_one() {
        for (size, overlap, cells) in [(8, 2, 29), (8, 4, 8), (8, 0, 20), (5, 2, 6), (64, 16, 3), (1, 0, 4)] {
            let tiles = Tiling::new(size, overlap).unwrap().axis(cells, 4);
            let mut total = vec![0.0f32; cells * 4];
            for tile in &tiles {
                assert_eq!(tile.weights.len(), tile.pixels(4).len());
                total[tile.pixels(4)].iter_mut().zip(&tile.weights).for_each(|(t, w)| *t += w);
            }
            assert!(total.iter().all(|t| (t - 1.0).abs() < 1e-6), "{size} {overlap} {cells}: {total:?}");
        }
    }

    #[test]
    fn too_much_overlap_and_empty_tiles_are_refused() {
        assert!(Tiling::new(0, 0).is_err());
        assert!(Tiling::new(8, 5).is_err());
        assert!(serde_json::from_str::<Tiling>(r#"{"size":8,"overlap":5}"#).is_err());
        assert_eq!(serde_json::from_str::<Tiling>(r#"{"size":8,"overlap":2}"#).unwrap(), Tiling::new(8, 2).unwrap());
    }
}
