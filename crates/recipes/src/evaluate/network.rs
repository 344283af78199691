//! The networks that metrics look through, and what a number may be called when it was computed with them.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use burn::tensor::{Device, Tensor, TensorData};
use features::{Tap, Vgg16};
use metrics::{Feature, Raster, ResizeFilter, Seam, mutual_matches};

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

/// A frozen network that turns a batch of pictures into rows of features. One picture's row does not depend on its neighbours.
pub trait PictureNetwork: Send + Sync {
    /// How it wants its pictures.
    fn feature(&self) -> &Feature;

    /// Numbers per picture.
    fn width(&self) -> usize;

    /// Features `[N, D]`.
    ///
    /// # Errors
    /// Pictures of another size than [`PictureNetwork::feature`] says.
    fn features(&self, pictures: Pictures<'_>) -> anyhow::Result<Vec<f32>>;
}

/// Confidences of matches across seams.
pub trait SeamMatcher: Send + Sync {
    /// One list per seam; a seam's list does not depend on the others.
    ///
    /// # Errors
    /// Halves that the matcher cannot take.
    fn confidences(&self, seams: &[Seam]) -> anyhow::Result<Vec<Vec<f32>>>;
}

/// A network, its weights and whether they are the ones that the metric's own name needs.
pub struct Loaded<N: ?Sized> {
    /// The network.
    pub network: Box<N>,
    /// Its weights.
    pub weights: WeightsUsed,
    /// `None` for the official weights, else what the metric's name gets appended.
    pub stand_in: Option<String>,
}

/// Where weight files lie and where networks compute.
#[derive(Debug, Clone)]
pub struct NetworkFolder {
    /// Looked at first to last.
    pub folders: Vec<PathBuf>,
    /// Where networks compute.
    pub device: Device,
}

/// Convolutions of VGG-16 as they are named in weight folders, the first one found is taken.
const VGG16_FILES: [&str; 2] = ["vgg16-397923af.safetensors", "vgg16_conv_f16.safetensors"];

impl NetworkFolder {
    /// The network for a protocol's feature: the one it names, or a stand-in.
    ///
    /// # Errors
    /// No weights in any folder, or a file that does not hold them.
    pub fn pictures(&self, wanted: &Feature) -> anyhow::Result<Loaded<dyn PictureNetwork>> {
        let path = self.find(&VGG16_FILES, &wanted.network)?;
        let network = VggPool::load(&path, &self.device)?;
        let stand_in = Some("vgg16-relu5_3".to_owned());
        Ok(Loaded { network: Box::new(network), weights: weights_used("vgg16", &path)?, stand_in })
    }

    /// The matcher for view consistency: LoFTR, or a stand-in.
    ///
    /// # Errors
    /// As [`NetworkFolder::pictures`].
    pub fn matcher(&self) -> anyhow::Result<Loaded<dyn SeamMatcher>> {
        let path = self.find(&VGG16_FILES, "loftr_outdoor")?;
        let network = VggMatcher { vgg: load_vgg(&path, &self.device)?, device: self.device.clone() };
        let stand_in = Some("vgg16-relu4_3".to_owned());
        Ok(Loaded { network: Box::new(network), weights: weights_used("vgg16", &path)?, stand_in })
    }

    fn find(&self, names: &[&str], network: &str) -> anyhow::Result<PathBuf> {
        let candidates = self.folders.iter().flat_map(|folder| names.iter().map(move |name| folder.join(name)));
        match candidates.into_iter().find(|path| path.is_file()) {
            Some(path) => Ok(path),
            None => bail!(
                "there are no weights for {network}: none of {} is in {}; put a file there or name another folder with --weights, \
                 or choose protocols without networks with --protocol",
                names.join(", "),
                if self.folders.is_empty() { "(no folder given)".to_owned() } else { listed(&self.folders) },
            ),
        }
    }
}

fn listed(folders: &[PathBuf]) -> String {
    folders.iter().map(|folder| folder.display().to_string()).collect::<Vec<_>>().join(", ")
}

fn load_vgg(path: &Path, device: &Device) -> anyhow::Result<Vgg16> {
    Vgg16::load(path, device).with_context(|| format!("cannot use the weights {}", path.display()))
}

fn weights_used(network: &str, path: &Path) -> anyhow::Result<WeightsUsed> {
    let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok(WeightsUsed { network: network.to_owned(), file, sha256: train::fingerprint(path)?.1 })
}

/// A picture as a network wants it: resized by the protocol's filter, values in [0, 1], planes.
pub fn network_input(picture: &Raster<u8>, feature: &Feature) -> Vec<f32> {
    let [height, width] = feature.size;
    let unit = |raster: &Raster<u8>| raster.map(|value| f32::from(value) / 255.0).planes();
    match feature.filter {
        // PyTorch and TensorFlow resize fractions, Pillow bytes.
        ResizeFilter::TorchBilinear | ResizeFilter::Tf1Bilinear => {
            let half_pixel = feature.filter == ResizeFilter::TorchBilinear;
            picture.map(|value| f32::from(value) / 255.0).interpolated(height, width, half_pixel).planes()
        }
        filter => unit(&picture.resized(height, width, filter)),
    }
}

fn tensor(pictures: Pictures<'_>, device: &Device) -> anyhow::Result<Tensor<4>> {
    let shape = [pictures.count, 3, pictures.height, pictures.width];
    if pictures.values.len() != shape.iter().product::<usize>() {
        bail!("{} values are no pictures {shape:?}", pictures.values.len());
    }
    Ok(Tensor::from_data(TensorData::new(pictures.values.to_vec(), shape), device))
}

/// Mean over all positions of the last block of VGG-16, 512 numbers.
struct VggPool {
    vgg: Vgg16,
    feature: Feature,
    device: Device,
}

/// Side of the pictures for [`VggPool`], px: small, because it stands in for smaller networks.
const VGG_SIDE: usize = 112;

impl VggPool {
    fn load(path: &Path, device: &Device) -> anyhow::Result<Self> {
        let feature = Feature {
            network: "vgg16".to_owned(),
            layer: "relu5_3".to_owned(),
            filter: ResizeFilter::PilBilinear,
            size: [VGG_SIDE; 2],
            range: [0.0, 1.0],
        };
        Ok(Self { vgg: load_vgg(path, device)?, feature, device: device.clone() })
    }
}

impl PictureNetwork for VggPool {
    fn feature(&self) -> &Feature {
        &self.feature
    }

    fn width(&self) -> usize {
        512
    }

    fn features(&self, pictures: Pictures<'_>) -> anyhow::Result<Vec<f32>> {
        let taps = self.vgg.forward(tensor(pictures, &self.device)?, Tap::Relu5_3);
        let last = taps.into_iter().last().context("VGG-16 gave no features")?;
        Ok(ops::mean_dim(ops::mean_dim(last, 3), 2).into_data().iter::<f32>().collect())
    }
}

/// Dual softmax over unit-length features of VGG-16 at an eighth of the size.
struct VggMatcher {
    vgg: Vgg16,
    device: Device,
}

/// Sharpness of the softmax, as in LoFTR.
const TEMPERATURE: f32 = 0.1;

impl VggMatcher {
    /// `[C, cells]`, unit length along C, and the grid.
    fn features(&self, half: &[f32], seam: &Seam) -> anyhow::Result<(Tensor<2>, [usize; 2])> {
        let rgb = [half, half, half].concat();
        let input = Pictures { count: 1, height: seam.height, width: seam.width, values: &rgb };
        let taps = self.vgg.forward(tensor(input, &self.device)?, Tap::Relu4_3);
        let last = taps.into_iter().last().context("VGG-16 gave no features")?;
        let [_, channels, rows, columns] = last.dims();
        let flat: Tensor<2> = last.reshape([channels, rows * columns]);
        let length = ops::sum_dim(flat.clone().square(), 0).sqrt().clamp_min(1e-10);
        Ok((flat / length, [rows, columns]))
    }
}

impl SeamMatcher for VggMatcher {
    fn confidences(&self, seams: &[Seam]) -> anyhow::Result<Vec<Vec<f32>>> {
        let one = |seam: &Seam| {
            let (left, grid) = self.features(&seam.left, seam)?;
            let (right, _) = self.features(&seam.right, seam)?;
            let similarity = left.transpose().matmul(right) / TEMPERATURE;
            Ok(mutual_matches(&similarity.into_data().iter::<f32>().collect::<Vec<_>>(), grid))
        };
        seams.iter().map(one).collect()
    }
}
