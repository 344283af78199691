//! The datasets a config file can name.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::argoverse2::{Argoverse2, Argoverse2Config};
use crate::nuplan::{NuPlan, NuPlanConfig};
use crate::nuscenes::{NuScenes, NuScenesConfig};
use crate::procedural::{Procedural, ProceduralConfig};
use crate::waymo::{Waymo, WaymoConfig};
use crate::wayvescenes::{WayveScenes, WayveScenesConfig};
use crate::{DataError, SceneDataset};

/// Makes the serde enum and the arm that opens each kind: a new dataset is one line.
macro_rules! datasets {
    ($($(#[$doc:meta])* $kind:literal => $dataset:ident($config:ident),)+) => {
        /// One dataset of a config file; `kind` selects it, unknown kinds and settings are refused.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "kind")]
        pub enum DatasetConfig {
            $($(#[$doc])* #[serde(rename = $kind)] $dataset($config),)+
        }

        /// Opens a dataset.
        ///
        /// # Errors
        /// Whatever its reader refuses.
        pub fn open(config: &DatasetConfig) -> Result<Arc<dyn SceneDataset>, DataError> {
            match config {
                $(DatasetConfig::$dataset(config) => Ok(Arc::new($dataset::open(config)?)),)+
            }
        }
    };
}

datasets! {
    /// The procedural world.
    "procedural" => Procedural(ProceduralConfig),
    /// The nuScenes tables, also those our own writer makes.
    "nuscenes" => NuScenes(NuScenesConfig),
    /// nuPlan logs with pictures.
    "nuplan" => NuPlan(NuPlanConfig),
    /// WayveScenes101, also what our own writer makes.
    "wayve_scenes101" => WayveScenes(WayveScenesConfig),
    /// Waymo Open Dataset, perception: either release.
    "waymo" => Waymo(WaymoConfig),
    /// The Argoverse 2 sensor dataset, also that of our own writer.
    "argoverse2" => Argoverse2(Argoverse2Config),
}
