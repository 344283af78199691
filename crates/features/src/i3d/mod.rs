//! I3D: Inception-v1 with its kernels inflated along time, trained on Kinetics-400; the network of the Fréchet video distance.
//!
//! Network: Carreira & Zisserman, "Quo Vadis, Action Recognition?". Names and padding as in the PyTorch port that video
//! generation uses (`i3d_pretrained_400.pt`). Parity: `tests/it/i3d.rs`. Shapes: N clips, T frames.

mod layers;

use std::path::Path;

use burn::tensor::{Device, Tensor};
use nn::weights::{WeightError, WeightFile};
use ops::{PixelCentres, resize_bilinear};

use crate::frozen::{NORM_COUNTER, Values, beside, load_strict};
use layers::{Conv3d, MaxPool3d, Mixed};

/// Side of the network's input.
pub const I3D_SIZE: usize = 224;

/// Fewest frames of a clip: time is halved three times, then pooled over two.
pub const I3D_MIN_FRAMES: usize = 9;

const CLASSES: usize = 400;
const WIDTH: usize = 1024;

/// Channels of a mixed block's four branches: 1×1; 1×1 → 3×3×3; 1×1 → 3×3×3; pool → 1×1.
const MIXED: [(&str, [usize; 6]); 9] = [
    ("Mixed_3b", [64, 96, 128, 16, 32, 32]),
    ("Mixed_3c", [128, 128, 192, 32, 96, 64]),
    ("Mixed_4b", [192, 96, 208, 16, 48, 64]),
    ("Mixed_4c", [160, 112, 224, 24, 64, 64]),
    ("Mixed_4d", [128, 128, 256, 24, 64, 64]),
    ("Mixed_4e", [112, 144, 288, 32, 64, 64]),
    ("Mixed_4f", [256, 160, 320, 32, 128, 128]),
    ("Mixed_5b", [256, 160, 320, 32, 128, 128]),
    ("Mixed_5c", [384, 192, 384, 48, 128, 128]),
];

/// What is added to the variances of the batch norms. The published weights are used with both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum I3dEpsilon {
    /// 1e-5, as the PyTorch port has it: published FVD values computed with that port.
    Port,
    /// 1e-3, as the original TensorFlow network has it.
    TensorFlow,
}

/// One step of the network, by the name that the port gives it.
#[derive(Debug, Clone)]
enum Stage {
    Conv(Box<Conv3d>),
    Pool(MaxPool3d),
    Mixed(Box<Mixed>),
}

/// Frozen I3D.
#[derive(Debug, Clone)]
pub struct I3d {
    stages: Vec<(&'static str, Stage)>,
    /// `[400, 1024]` and `[400]`
    classes: (Tensor<2>, Tensor<1>),
}

/// What one pass gives.
#[derive(Debug, Clone)]
pub struct I3dFeatures {
    /// `[N, 1024, T']`, T' = ⌈T / 8⌉ − 1; protocols that name `pool1024` take its mean over time.
    pub pooled: Tensor<3>,
    /// `[N, 400]`, averaged over time; protocols that name `logits400`.
    pub logits: Tensor<2>,
}

impl I3d {
    /// Loads the PyTorch port's state dict (`Conv3d_1a_7x7.conv3d.weight`, …).
    ///
    /// # Errors
    /// What [`WeightFile::open`] reports, and [`WeightError::Mismatch`] with every missing, unexpected and wrongly shaped name.
    pub fn load(path: impl AsRef<Path>, epsilon: I3dEpsilon, device: &Device) -> Result<Self, WeightError> {
        let file = WeightFile::open(path)?.without_prefix("module.");
        load_strict(&file, device, |name| name.ends_with(NORM_COUNTER), |values| Self::read(epsilon, values))
    }

    /// Builds the network from `values(name, shape)`.
    ///
    /// # Errors
    /// The first error of `values`, or [`WeightError::Count`] when it returns another number of values.
    pub fn from_values(
        epsilon: I3dEpsilon,
        device: &Device,
        mut values: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError>,
    ) -> Result<Self, WeightError> {
        Self::read(epsilon, &mut Values::new(device, &mut values))
    }

    fn read(epsilon: I3dEpsilon, values: &mut Values<'_>) -> Result<Self, WeightError> {
        let epsilon = match epsilon {
            I3dEpsilon::Port => 1e-5,
            I3dEpsilon::TensorFlow => 1e-3,
        };
        let pool = |kernel, stride| Stage::Pool(MaxPool3d { kernel, stride });
        let mut conv = |name: &'static str, [out, channels]: [usize; 2], kernel: usize, stride: usize| {
            let shape = [out, channels, kernel, kernel, kernel];
            Ok::<_, WeightError>((name, Stage::Conv(Box::new(Conv3d::read(values, name, shape, stride, epsilon)?))))
        };
        let mut stages = vec![
            conv("Conv3d_1a_7x7", [64, 3], 7, 2)?,
            ("MaxPool3d_2a_3x3", pool([1, 3, 3], [1, 2, 2])),
            conv("Conv3d_2b_1x1", [64, 64], 1, 1)?,
            conv("Conv3d_2c_3x3", [192, 64], 3, 1)?,
            ("MaxPool3d_3a_3x3", pool([1, 3, 3], [1, 2, 2])),
        ];
        let mut channels = 192;
        for (name, widths) in MIXED {
            match name {
                "Mixed_4b" => stages.push(("MaxPool3d_4a_3x3", pool([3; 3], [2; 3]))),
                "Mixed_5b" => stages.push(("MaxPool3d_5a_2x2", pool([2; 3], [2; 3]))),
                _ => {}
            }
            stages.push((name, Stage::Mixed(Box::new(Mixed::read(values, name, channels, widths, epsilon)?))));
            channels = widths[0] + widths[2] + widths[4] + widths[5];
        }
        let weight = values.tensor("logits.conv3d.weight", [CLASSES, WIDTH, 1, 1, 1])?.reshape([CLASSES, WIDTH]);
        Ok(Self { stages, classes: (weight, values.tensor("logits.conv3d.bias", [CLASSES])?) })
    }

    /// The network's input: every frame bilinear to 224×224 with half-pixel centres and without antialiasing, then `2x − 1`.
    ///
    /// # Shapes
    /// - clips: `[N, T, 3, H, W]`, RGB in [0, 1]
    /// - output: `[N, 3, T, 224, 224]`
    #[must_use]
    pub fn prepare(clips: Tensor<5>) -> Tensor<5> {
        let [count, frames, colours, height, width] = clips.dims();
        let flat = clips.reshape([count * frames, colours, height, width]);
        let resized = resize_bilinear(flat, [I3D_SIZE; 2], PixelCentres::Half) * 2.0 - 1.0;
        resized.reshape([count, frames, colours, I3D_SIZE, I3D_SIZE]).swap_dims(1, 2)
    }

    /// Features of clips of at least [`I3D_MIN_FRAMES`] frames.
    ///
    /// # Shapes
    /// - clips: `[N, T, 3, H, W]`, RGB in [0, 1]
    #[must_use]
    pub fn features(&self, clips: Tensor<5>) -> I3dFeatures {
        self.forward(Self::prepare(clips), |_, _| ())
    }

    /// Runs the network and shows `look` the output of every stage under the port's name for it.
    ///
    /// # Shapes
    /// - input: `[N, 3, T, 224, 224]`
    #[must_use]
    pub fn forward(&self, input: Tensor<5>, mut look: impl FnMut(&str, &Tensor<5>)) -> I3dFeatures {
        let [_, colours, frames, height, width] = input.dims();
        assert_eq!([colours, height, width], [3, I3D_SIZE, I3D_SIZE], "I3D looks at clips [N, 3, T, 224, 224]");
        assert!(frames >= I3D_MIN_FRAMES, "I3D needs {I3D_MIN_FRAMES} frames, the clips have {frames}");
        let map = self.stages.iter().fold(input, |x, (name, stage)| {
            let output = match stage {
                Stage::Conv(conv) => conv.forward(x),
                Stage::Pool(pool) => pool.forward(x),
                Stage::Mixed(mixed) => mixed.forward(x),
            };
            look(name, &output);
            output
        });
        self.head(map)
    }

    /// Average over 2 frames and all 7×7 positions, then class scores, averaged over time.
    fn head(&self, map: Tensor<5>) -> I3dFeatures {
        let [count, channels, frames, height, width] = map.dims();
        let per_frame = ops::mean_dim(map.reshape([count, channels, frames, height * width]), 3);
        let per_frame = per_frame.reshape([count, channels, frames]);
        let steps = frames - 1;
        let pooled = (per_frame.clone().narrow(2, 0, steps) + per_frame.narrow(2, 1, steps)) / 2.0;
        let mean = ops::mean_dim(pooled.clone(), 2).reshape([count, channels]);
        let (weight, bias) = (beside(&self.classes.0, &mean), beside(&self.classes.1, &mean));
        // The mean over time and the linear head commute.
        I3dFeatures { pooled, logits: mean.matmul(weight.transpose()) + bias.unsqueeze::<2>() }
    }
}
