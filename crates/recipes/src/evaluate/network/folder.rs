//! Which file of a weight folder serves which network, and what a number is called then.

use std::path::PathBuf;

use anyhow::{Context, bail};
use burn::tensor::Device;
use features::{MissingWeights, known_weights};
use metrics::{Feature, ResizeFilter};

use super::clips::{FrameChanges, I3dClips};
use super::pairs::LpipsPairs;
use super::pictures::{EfficientNetPool, InceptionPool};
use super::seams::{LoftrSeams, VggSeams};
use super::{FeatureNetwork, Loaded, PairNetwork, SeamMatcher, WeightsUsed};

/// Where weight files lie and where networks compute.
#[derive(Debug, Clone)]
pub struct NetworkFolder {
    /// Looked at first to last.
    pub folders: Vec<PathBuf>,
    /// Where networks compute.
    pub device: Device,
}

const INCEPTION: &str = "pt_inception-2015-12-05-6726825d.pth";
const I3D: &str = "i3d_pretrained_400.pt";
const LOFTR: &str = "loftr_outdoor.ckpt";
const EFFICIENTNET: &str = "efficientnet_lite0_imagenet.safetensors";
const NSFWJS: &str = "inception_v3_nsfwjs_u8.safetensors";
const VGG: &str = "vgg16_conv_f16.safetensors";
const VGG_TORCHVISION: &str = "vgg16-397923af.pth";
const SQUEEZENET: &str = "squeezenet1_1_imagenet_ndf.safetensors";
const SQUEEZENET_TORCHVISION: &str = "squeezenet1_1-b8a52dc0.pth";
const HEADS: &str = "lpips_linear_heads_v0.1.safetensors";

/// A file that was found, and what the number is called with it.
struct Found {
    path: PathBuf,
    file: &'static str,
    stand_in: Option<&'static str>,
}

impl NetworkFolder {
    /// The network for features of single pictures: the one a protocol names, or a stand-in.
    ///
    /// # Errors
    /// No weights in any folder, an official file with another hash, or a file that does not hold the network.
    pub fn pictures(&self, wanted: &Feature) -> anyhow::Result<Loaded<dyn FeatureNetwork>> {
        let stand_ins = [(EFFICIENTNET, Some("efficientnet-lite0")), (NSFWJS, Some("nsfwjs"))];
        let candidates = match wanted.network.as_str() {
            "inception_v3_fid" => [&[(INCEPTION, None)][..], &stand_ins].concat(),
            "efficientnet_lite0" => stand_ins.to_vec(),
            other => {
                bail!("there is no network {other}; known are inception_v3_fid, efficientnet_lite0 and i3d_kinetics400")
            }
        };
        let found = self.find(&candidates)?;
        let network: Box<dyn FeatureNetwork> = match found.file {
            INCEPTION | NSFWJS => Box::new(InceptionPool::load(&found.path, wanted, &self.device)?),
            _ => Box::new(EfficientNetPool::load(&found.path, &self.device)?),
        };
        Ok(Loaded { network, weights: found.weights()?, stand_in: found.stand_in.map(str::to_owned) })
    }

    /// The network for features of clips: I3D, or a network of single frames whose levels and changes stand in.
    ///
    /// # Errors
    /// As [`NetworkFolder::pictures`].
    pub fn clips(&self, wanted: &Feature) -> anyhow::Result<Loaded<dyn FeatureNetwork>> {
        if wanted.network == "i3d_kinetics400" {
            let found = self.find(&[(I3D, None), (EFFICIENTNET, Some(""))])?;
            if found.file == I3D {
                let network = Box::new(I3dClips::load(&found.path, wanted, &self.device)?);
                return Ok(Loaded { network, weights: found.weights()?, stand_in: None });
            }
        }
        let size = [features::EFFICIENTNET_SIZE; 2];
        let frames = Feature {
            network: "efficientnet_lite0".to_owned(),
            filter: ResizeFilter::PilBicubic,
            size,
            ..wanted.clone()
        };
        let Loaded { network, weights, stand_in } = self.pictures(&frames)?;
        Ok(Loaded { network: Box::new(FrameChanges::new(network)), weights, stand_in })
    }

    /// The matcher for view consistency: LoFTR, or features of VGG-16.
    ///
    /// # Errors
    /// As [`NetworkFolder::pictures`].
    pub fn matcher(&self) -> anyhow::Result<Loaded<dyn SeamMatcher>> {
        let found = self.find(&[(LOFTR, None), (VGG, Some("vgg16-conv4_3"))])?;
        let network: Box<dyn SeamMatcher> = match found.file {
            LOFTR => Box::new(LoftrSeams::load(&found.path, &self.device)?),
            _ => Box::new(VggSeams::load(&found.path, &self.device)?),
        };
        Ok(Loaded { network, weights: found.weights()?, stand_in: found.stand_in.map(str::to_owned) })
    }

    /// LPIPS with the heads of its release on `vgg16` or `squeezenet1_1`; on other weights of that network a stand-in.
    ///
    /// # Errors
    /// As [`NetworkFolder::pictures`]; the heads are needed too.
    pub fn pairs(&self, network: &str) -> anyhow::Result<Loaded<dyn PairNetwork>> {
        let candidates = match network {
            "vgg16" => [(VGG_TORCHVISION, None), (VGG, Some("vgg16"))],
            "squeezenet1_1" => [(SQUEEZENET_TORCHVISION, None), (SQUEEZENET, Some("squeezenet1_1"))],
            other => bail!("LPIPS looks through vgg16 or squeezenet1_1, not through {other}"),
        };
        let (found, heads) = (self.find(&candidates)?, self.find(&[(HEADS, None)])?);
        let is_vgg = network == "vgg16";
        let pairs = LpipsPairs::load(&found.path, &heads.path, is_vgg, &self.device)?;
        Ok(Loaded { network: Box::new(pairs), weights: found.weights()?, stand_in: found.stand_in.map(str::to_owned) })
    }

    fn find(&self, candidates: &[(&'static str, Option<&'static str>)]) -> anyhow::Result<Found> {
        for (file, stand_in) in candidates {
            let path = self.folders.iter().map(|folder| folder.join(file)).find(|path| path.is_file());
            if let Some(path) = path {
                return Ok(Found { path, file, stand_in: *stand_in });
            }
        }
        let file = candidates.first().map_or("", |(file, _)| file);
        let path = self.folders.first().map_or_else(|| PathBuf::from(file), |folder| folder.join(file));
        let missing = MissingWeights { path, known: known_weights(file) };
        Err(missing).context(
            "there are no weights for this network; name the folder they are in with --weights, or choose protocols without networks with --protocol",
        )
    }
}

impl Found {
    /// # Errors
    /// An official file whose hash is not the published one.
    fn weights(&self) -> anyhow::Result<WeightsUsed> {
        let sha256 = train::fingerprint(&self.path)?.1;
        let known = known_weights(self.file);
        if known.and_then(|known| known.matches(&sha256)) == Some(false) {
            let published = known.and_then(|known| known.sha256).unwrap_or_default();
            bail!(
                "this is not the published file: its SHA-256 is {sha256}, the published one begins with {published}; get it again, or \
                 remove it to use a stand-in: {}",
                self.path.display()
            );
        }
        let network = self.stand_in.map_or_else(|| "official".to_owned(), str::to_owned);
        Ok(WeightsUsed { network, file: self.file.to_owned(), sha256 })
    }
}
