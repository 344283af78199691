//! What the binaries do, one file per subcommand.

mod check_data;
mod check_table;
mod common;
mod data_source;
mod encode;
mod evaluate;
mod info;
mod make_data;
mod novel_view;
mod reconstruct;
mod sample;
mod show_data;
mod train_autoencoder;
mod train_dit;
mod train_unet;
mod train_vae;
mod training;

pub use check_data::{CheckDataArgs, check_data};
pub use common::{DataArgs, LoadedModel, UsageError, run_main};
pub use data_source::{Chosen, DataSource, Named};
pub use encode::{EncodeArgs, encode};
pub use evaluate::{EvaluateArgs, evaluate};
pub use info::{InfoArgs, info};
pub use make_data::{MakeDataArgs, make_data};
pub use novel_view::{NovelViewArgs, novel_view};
pub use reconstruct::{ReconstructArgs, reconstruct};
pub use sample::{SampleArgs, sample};
pub use show_data::{ShowDataArgs, show_data};
pub use train_autoencoder::{TrainAutoencoderArgs, train_autoencoder};
pub use train_dit::{TrainDitArgs, train_dit};
pub use train_unet::{TrainUNetArgs, train_unet};
pub use train_vae::{TrainVaeArgs, train_vae};
pub use training::TrainArgs;
