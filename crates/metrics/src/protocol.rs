//! Named protocols: everything that moves a published number beside the model. Data, not code; the built-in ones are in
//! `protocols.toml`, further ones come from a user's file of the same form.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use crate::{KidSubsets, MetricError, Raster, ResizeFilter, SsimWindow};

/// One way to compute one number.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Protocol {
    /// `metric/whose`; never used again for other settings.
    pub name: String,
    /// What it says in a report before the run starts.
    pub text: String,
    /// Where the settings come from.
    pub source: String,
    /// What is computed.
    pub metric: MetricChoice,
    /// What happens to real pictures first.
    #[serde(default)]
    pub real: Vec<PictureStep>,
    /// What happens to generated pictures first.
    #[serde(default)]
    pub generated: Vec<PictureStep>,
    /// Which frames count.
    #[serde(default)]
    pub frames: FrameRule,
    /// Which cameras count.
    #[serde(default)]
    pub views: ViewRule,
    /// Pictures or clips that the published numbers were computed from.
    #[serde(default)]
    pub samples: Option<u64>,
}

/// The metrics a protocol can ask for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum MetricChoice {
    /// Peak signal-to-noise ratio, mean over pictures.
    Psnr,
    /// Structural similarity, mean over pictures.
    Ssim {
        /// Window of the local statistics.
        window: SsimWindow,
    },
    /// Multi-scale structural similarity.
    MsSsim,
    /// Learned perceptual distance.
    Lpips {
        /// Network under the heads.
        network: String,
    },
    /// Fréchet distance of pictures.
    Fid {
        /// What the features are.
        feature: Feature,
    },
    /// Kernel distance of pictures.
    Kid {
        /// What the features are.
        feature: Feature,
        /// Subsets.
        #[serde(default)]
        subsets: KidSubsets,
    },
    /// Precision and recall of pictures.
    PrecisionRecall {
        /// What the features are.
        feature: Feature,
        /// Balls reach to this neighbour.
        neighbours: usize,
        /// Most samples of a side.
        most: usize,
    },
    /// Fréchet distance of clips.
    Fvd {
        /// What the features are.
        feature: Feature,
        /// How clips are cut.
        clip: ClipRule,
    },
    /// Consistency of neighbouring views, generated over real.
    Mvsc,
    /// Consistency of neighbouring views, times 100.
    Vms,
}

/// A network's layer and how pictures enter it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Feature {
    /// The network that gives the metric its name.
    pub network: String,
    /// Its layer.
    pub layer: String,
    /// How pictures come to the network's size.
    pub filter: ResizeFilter,
    /// Network size, rows and columns.
    pub size: [usize; 2],
    /// What 0 and 1 become.
    pub range: [f64; 2],
}

/// How clips are cut from the frames of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipRule {
    /// Frames of a clip.
    pub length: usize,
    /// Frames from one frame of a clip to the next.
    #[serde(default = "one")]
    pub stride: usize,
    /// Frames from the start of one clip to the start of the next; the clip's extent by default.
    #[serde(default)]
    pub step: Option<usize>,
    /// How often each frame is shown.
    #[serde(default = "one")]
    pub repeat: usize,
    /// Whether frames that the generator was given count.
    #[serde(default)]
    pub count_condition_frames: bool,
}

const fn one() -> usize {
    1
}

/// Which frames of a data set count.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameRule {
    /// Every frame given.
    #[default]
    All,
    /// Annotated frames only.
    KeyFrames,
}

/// Which cameras count.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ViewRule {
    /// Every camera.
    #[default]
    All,
    /// The one that looks closest to straight ahead.
    Front,
}

/// One step of bringing a stored picture to the size at which it is compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum PictureStep {
    /// To a size, aspect ratio not kept.
    Resize {
        /// How.
        filter: ResizeFilter,
        /// Rows.
        height: usize,
        /// Columns.
        width: usize,
    },
    /// Both sides times a factor, rounded.
    Scale {
        /// How.
        filter: ResizeFilter,
        /// Above 0.
        factor: f64,
    },
    /// Keeps a part.
    Crop {
        /// Rows cut above.
        #[serde(default)]
        top: usize,
        /// Columns cut on the left.
        #[serde(default)]
        left: usize,
        /// Rows kept.
        height: usize,
        /// Columns kept.
        width: usize,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ProtocolFile {
    protocol: Vec<Protocol>,
}

/// Largest side that a protocol may ask for, px.
const MOST_SIDE: usize = 8192;

impl Protocol {
    /// The protocols that ship with the program.
    ///
    /// # Errors
    /// None for the file that is compiled in; a test reads it.
    pub fn built_in() -> Result<Vec<Self>, MetricError> {
        Self::parse(include_str!("protocols.toml"))
    }

    /// Protocols of a TOML text, `[[protocol]]` tables.
    ///
    /// # Errors
    /// [`MetricError::Protocol`] naming the key or protocol.
    pub fn parse(text: &str) -> Result<Vec<Self>, MetricError> {
        let file: ProtocolFile = toml::from_str(text).map_err(|error| MetricError::Protocol(error.to_string()))?;
        let mut names = BTreeSet::new();
        for protocol in &file.protocol {
            protocol.check().map_err(|why| MetricError::Protocol(format!("protocol {}: {why}", protocol.name)))?;
            if !names.insert(&protocol.name) {
                let name = &protocol.name;
                return Err(MetricError::Protocol(format!(
                    "protocol {name} stands twice; changed settings need a new name"
                )));
            }
        }
        Ok(file.protocol)
    }

    fn check(&self) -> Result<(), String> {
        for step in self.real.iter().chain(&self.generated) {
            let (sides, factor) = match *step {
                PictureStep::Resize { height, width, .. } | PictureStep::Crop { height, width, .. } => {
                    ([height, width], 1.0)
                }
                PictureStep::Scale { factor, .. } => ([1, 1], factor),
            };
            let sound = sides.iter().all(|side| (1..=MOST_SIDE).contains(side)) && factor > 0.0 && factor <= 16.0;
            if !sound {
                return Err("sides must lie in 1..=8192 and factors in (0, 16]".to_owned());
            }
        }
        if let MetricChoice::Fvd { clip, .. } = &self.metric
            && [clip.length, clip.stride, clip.repeat, clip.step.unwrap_or(1)].contains(&0)
        {
            return Err("length, stride, step and repeat of clips must be at least 1".to_owned());
        }
        match self.feature() {
            Some(feature) if !feature.size.iter().all(|side| (1..=MOST_SIDE).contains(side)) => {
                Err("the network size must lie in 1..=8192".to_owned())
            }
            _ => Ok(()),
        }
    }

    /// The features the metric compares, if it does.
    #[must_use]
    pub fn feature(&self) -> Option<&Feature> {
        match &self.metric {
            MetricChoice::Fid { feature }
            | MetricChoice::Kid { feature, .. }
            | MetricChoice::PrecisionRecall { feature, .. }
            | MetricChoice::Fvd { feature, .. } => Some(feature),
            _ => None,
        }
    }
}

impl PictureStep {
    /// The picture after this step; `None` when a crop reaches beyond it.
    #[must_use]
    pub fn apply(&self, picture: &Raster<u8>) -> Option<Raster<u8>> {
        match *self {
            Self::Resize { filter, height, width } => Some(picture.resized(height, width, filter)),
            Self::Scale { filter, factor } => {
                let side = |side: usize| ((side as f64 * factor).round() as usize).clamp(1, MOST_SIDE);
                Some(picture.resized(side(picture.height), side(picture.width), filter))
            }
            Self::Crop { top, left, height, width } => picture.cropped(top, left, height, width),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_protocols_are_sound() {
        let all = Protocol::built_in().unwrap();
        let names: Vec<&str> = all.iter().map(|protocol| protocol.name.as_str()).collect();
        for name in ["psnr/bev-vae", "ssim/skimage7", "fid/magicdrive", "fvd/opendwm", "mvsc/v1", "vms/ours"] {
            assert!(names.contains(&name), "{name}");
        }
        assert!(all.iter().all(|protocol| !protocol.text.is_empty() && !protocol.source.is_empty()));
        for protocol in &all {
            let text = serde_json::to_string(protocol).unwrap();
            assert_eq!(&serde_json::from_str::<Protocol>(&text).unwrap(), protocol, "reports hold the whole protocol");
        }
    }

    #[test]
    fn magicdrive_pictures_are_scaled_and_lose_their_top_row() {
        let all = Protocol::built_in().unwrap();
        let protocol = all.iter().find(|protocol| protocol.name == "fid/magicdrive").unwrap();
        let raw = Raster { height: 900, width: 1600, pixels: vec![9; 900 * 1600 * 3] };
        let found = protocol.real.iter().try_fold(raw, |picture, step| step.apply(&picture)).unwrap();
        assert_eq!((found.height, found.width), (224, 400));
        let small = Raster { height: 10, width: 10, pixels: vec![0; 300] };
        assert_eq!(protocol.real.iter().try_fold(small, |picture, step| step.apply(&picture)), None);
    }

    #[test]
    fn mistakes_are_named() {
        let base = "[[protocol]]\nname = \"x/y\"\ntext = \"t\"\nsource = \"s\"\n";
        for (tail, why) in [
            ("metric = { kind = \"pnsr\" }\n", "pnsr"),
            ("metric = { kind = \"psnr\" }\nrael = []\n", "rael"),
            ("metric = { kind = \"psnr\" }\nreal = [{ do = \"crop\", height = 0, width = 4 }]\n", "8192"),
            ("metric = { kind = \"ssim\", window = \"uniform8\" }\n", "uniform8"),
        ] {
            let error = Protocol::parse(&format!("{base}{tail}")).unwrap_err().to_string();
            assert!(error.contains(why), "{error}");
        }
        let one = format!("{base}metric = {{ kind = \"psnr\" }}\n");
        assert!(Protocol::parse(&format!("{one}{one}")).unwrap_err().to_string().contains("twice"));
        assert_eq!(Protocol::parse(&one).unwrap().len(), 1);
    }
}
