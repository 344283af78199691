//! Trains the autoencoder of latent diffusion.

use std::process::ExitCode;

use clap::Parser;
use rigscape::commands::{TrainAutoencoderArgs, run_main, train_autoencoder};

fn main() -> ExitCode {
    let args = TrainAutoencoderArgs::parse();
    run_main(|| train_autoencoder(&args))
}
