//! What the binaries do, one file per subcommand.

mod check_data;
mod common;
mod info;
mod make_data;
mod novel_view;
mod reconstruct;
mod train_vae;

pub use check_data::{CheckDataArgs, check_data};
pub use common::{DataArgs, LoadedModel, run_main};
pub use info::{InfoArgs, info};
pub use make_data::{MakeDataArgs, make_data};
pub use novel_view::{NovelViewArgs, novel_view};
pub use reconstruct::{ReconstructArgs, reconstruct};
pub use train_vae::{TrainVaeArgs, train_vae};
