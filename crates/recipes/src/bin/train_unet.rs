//! Trains the UNet of latent diffusion.

use std::process::ExitCode;

use clap::Parser;
use rigscape::commands::{TrainUNetArgs, run_main, train_unet};

fn main() -> ExitCode {
    let args = TrainUNetArgs::parse();
    run_main(|| train_unet(&args))
}
