//! The networks that metrics look through. One picture's, clip's or seam's result never depends on its neighbours.

mod clips;
mod folder;
mod pairs;
mod pictures;
mod seams;

use anyhow::bail;
use burn::tensor::{Device, Tensor, TensorData};
use metrics::{Feature, Raster, ResizeFilter, Seam};

pub use folder::NetworkFolder;

/// A file of weights as it was read.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct WeightsUsed {
    /// Network.
    pub network: String,
    /// File name.
    pub file: String,
    /// Of the whole file.
    pub sha256: String,
}

/// Pictures of one size, `[N, 3, H, W]`, in [0, 1].
#[derive(Debug, Clone, Copy)]
pub struct Pictures<'a> {
    /// How many.
    pub count: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// All values.
    pub values: &'a [f32],
}

impl Pictures<'_> {
    fn tensor(&self, device: &Device) -> anyhow::Result<Tensor<4>> {
        let shape = [self.count, 3, self.height, self.width];
        if self.values.len() != shape.iter().product::<usize>() {
            bail!("{} values are no pictures {shape:?}", self.values.len());
        }
        Ok(Tensor::from_data(TensorData::new(self.values.to_vec(), shape), device))
    }
}

/// A frozen network that turns pictures into features.
pub trait FeatureNetwork: Send + Sync {
    /// How it wants its pictures.
    fn feature(&self) -> &Feature;

    /// Numbers per row.
    fn width(&self) -> usize;

    /// Features `[N, D]` of pictures, or `[1, D]` of the frames of one clip where the network looks at clips.
    ///
    /// # Errors
    /// Pictures of another size than [`FeatureNetwork::feature`] says, clips that are too short.
    fn features(&self, pictures: Pictures<'_>) -> anyhow::Result<Vec<f32>>;
}

/// Confidences of matches across seams.
pub trait SeamMatcher: Send + Sync {
    /// One list per seam.
    ///
    /// # Errors
    /// Halves that the matcher cannot take.
    fn confidences(&self, seams: &[Seam]) -> anyhow::Result<Vec<Vec<f32>>>;
}

/// Distances of pairs of pictures.
pub trait PairNetwork: Send + Sync {
    /// The distance of two pictures of one size.
    ///
    /// # Errors
    /// Pictures that the network cannot take.
    fn distance(&self, real: Pictures<'_>, generated: Pictures<'_>) -> anyhow::Result<f64>;
}

/// A network, its weights and whether they are the ones that the metric's own name needs.
pub struct Loaded<N: ?Sized> {
    /// The network.
    pub network: Box<N>,
    /// Its weights.
    pub weights: WeightsUsed,
    /// `None` for the official weights, else what stands in the metric's name.
    pub stand_in: Option<String>,
}

/// A picture as a network wants it: resized by the protocol's filter, values in [0, 1], planes.
pub fn network_input(picture: &Raster<u8>, feature: &Feature) -> Vec<f32> {
    let [height, width] = feature.size;
    let unit = |raster: &Raster<u8>| raster.map(|value| f32::from(value) / 255.0);
    match feature.filter {
        // PyTorch and TensorFlow resize fractions, Pillow bytes.
        ResizeFilter::TorchBilinear | ResizeFilter::Tf1Bilinear => {
            let half_pixel = feature.filter == ResizeFilter::TorchBilinear;
            unit(picture).interpolated(height, width, half_pixel).planes()
        }
        filter => unit(&picture.resized(height, width, filter)).planes(),
    }
}
