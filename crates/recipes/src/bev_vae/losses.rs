//! The perceptual term with its frozen network.

use anyhow::{Context, ensure};
use burn::tensor::{Device, Tensor};
use features::{Lpips, LpipsBackbone, Tap, Vgg16};
use vae::pixels::denormalise;

use super::PerceptualConfig;

/// What a network's pictures hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelRange {
    /// ImageNet-normalised.
    ImageNet,
    /// RGB in [−1, 1].
    Signed,
}

/// VGG-16 and how it is used.
#[derive(Debug)]
pub struct Perceptual {
    distance: Distance,
    config: PerceptualConfig,
    range: PixelRange,
}

/// How features of two pictures are compared.
#[derive(Debug)]
enum Distance {
    /// Mean squared difference per tap, up to this one.
    Squared(Vgg16, Tap),
    /// Learned heads.
    Lpips(Lpips),
}

impl Distance {
    /// # Errors
    /// Names the file that does not fit.
    fn open(network: Vgg16, config: &PerceptualConfig, device: &Device) -> anyhow::Result<Self> {
        let Some(heads) = &config.heads else { return Ok(Self::Squared(network, config.last)) };
        ensure!(
            config.last == Tap::Relu5_3,
            "loss.perceptual: LPIPS has a head for every tap; leave `last` out, or `heads`"
        );
        let backbone = LpipsBackbone::Vgg(network);
        ensure!(
            backbone.fits_the_heads(),
            "loss.perceptual.heads: the heads of LPIPS were trained on torchvision's VGG-16, and loss.perceptual.weights is the Oxford \
             release; name vgg16-397923af.pth, or leave `heads` out"
        );
        Ok(Self::Lpips(Lpips::load(backbone, heads, device).context("loss.perceptual.heads")?))
    }

    /// `[1]` for two sets of pictures `[N, 3, H, W]` in [0, 1]; the target is a constant.
    fn of(&self, decoded: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
        match self {
            Self::Squared(network, last) => network.perceptual_loss(target, decoded, *last),
            Self::Lpips(lpips) => {
                let target = target.without_autodiff();
                let target = if decoded.is_autodiff() { Tensor::from_inner(target) } else { target };
                lpips.forward(decoded, target).mean()
            }
        }
    }
}

impl Perceptual {
    /// Loads the weights if the config names any.
    ///
    /// # Errors
    /// Names the weights file.
    pub fn open(config: &PerceptualConfig, range: PixelRange, device: &Device) -> anyhow::Result<Option<Self>> {
        let Some(path) = &config.weights else { return Ok(None) };
        let network = Vgg16::load(path, device).context("loss.perceptual.weights")?;
        Ok(Some(Self { distance: Distance::open(network, config, device)?, config: config.clone(), range }))
    }

    /// Views it looks at per step; 0 for all.
    pub fn views(&self) -> usize {
        self.config.views
    }

    /// Weighted L_perc of network pictures.
    ///
    /// # Shapes
    /// - decoded, target: `[N, 3, H, W]`, in the range given at opening
    /// - output: `[1]`
    pub fn loss(&self, decoded: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
        let rgb = |x: Tensor<4>| match self.range {
            PixelRange::Signed => (x + 1.0) * 0.5,
            PixelRange::ImageNet => {
                let [n, c, h, w] = x.dims();
                denormalise(x.reshape([1, n, c, h, w])).reshape([n, c, h, w])
            }
        };
        self.distance.of(rgb(decoded), rgb(target)) * self.config.weight
    }
}

#[cfg(test)]
mod tests {
    use features::Preprocessing;
    use safetensors::tensor::{Dtype, TensorView, serialize_to_file};

    use super::*;

    /// Small patterned kernels: signs that differ, so that no feature dies.
    fn network(preprocessing: Preprocessing, device: &Device) -> Vgg16 {
        let values = |_: &str, shape: &[usize]| {
            let count: usize = shape.iter().product();
            let scale = (2.0 / (count / shape[0]) as f32).sqrt();
            Ok((0..count).map(|at| (((at * 7919) % 1009) as f32 / 504.0 - 1.0) * scale).collect())
        };
        Vgg16::from_values(preprocessing, device, values).unwrap()
    }

    fn heads(folder: &std::path::Path) -> std::path::PathBuf {
        let path = folder.join("heads.safetensors");
        let rows: Vec<(String, usize, Vec<u8>)> = [64, 128, 256, 512, 512]
            .into_iter()
            .enumerate()
            .map(|(at, width)| (format!("vgg.lin{at}.model.1.weight"), width, 0.5_f32.to_le_bytes().repeat(width)))
            .collect();
        let views = rows.iter().map(|(name, width, bytes)| {
            (name.clone(), TensorView::new(Dtype::F32, vec![1, *width, 1, 1], bytes).unwrap())
        });
        serialize_to_file(views, None, &path).unwrap();
        path
    }

    #[test]
    fn heads_make_it_lpips_whose_gradient_reaches_the_painted_picture_alone() {
        let folder = tempfile::tempdir().unwrap();
        let device = Device::flex().autodiff();
        let config = PerceptualConfig { heads: Some(heads(folder.path())), ..PerceptualConfig::default() };
        let distance = Distance::open(network(Preprocessing::Torchvision, &device), &config, &device).unwrap();
        let picture = |shift: f32| {
            let values: Vec<f32> = (0..3 * 32 * 32).map(|at| ((at % 37) as f32 / 36.0 + shift).fract()).collect();
            Tensor::<1>::from_floats(values.as_slice(), &device).reshape([1, 3, 32, 32])
        };
        let decoded = picture(0.3).require_grad();
        let loss = distance.of(decoded.clone(), picture(0.0));
        let Distance::Lpips(lpips) = &distance else { panic!("heads were named") };
        let inner = |x: Tensor<4>| x.without_autodiff();
        let metric = lpips.forward(inner(picture(0.3)), inner(picture(0.0))).into_scalar::<f32>();
        assert!(metric > 0.0 && (loss.clone().into_scalar::<f32>() - metric).abs() <= 1e-6 * metric);
        let gradient = decoded.grad(&loss.backward()).unwrap();
        assert!(gradient.abs().max().into_scalar::<f32>() > 0.0);
        assert!(distance.of(picture(0.1), picture(0.1)).into_scalar::<f32>() < 1e-9);
    }

    #[test]
    fn heads_on_other_kernels_or_with_fewer_taps_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let device = Device::flex();
        let config = PerceptualConfig { heads: Some(heads(folder.path())), ..PerceptualConfig::default() };
        let refused = |preprocessing, config: &PerceptualConfig| {
            format!("{:#}", Distance::open(network(preprocessing, &device), config, &device).unwrap_err())
        };
        assert!(refused(Preprocessing::Caffe, &config).contains("vgg16-397923af.pth"));
        let fewer = PerceptualConfig { last: Tap::Relu2_2, ..config.clone() };
        assert!(refused(Preprocessing::Torchvision, &fewer).contains("`last`"));
        let absent = PerceptualConfig { heads: Some("absent.safetensors".into()), ..config };
        assert!(refused(Preprocessing::Torchvision, &absent).contains("absent.safetensors"));
    }
}
