//! Trains the transformer over latents of BEV-VAE.

use std::process::ExitCode;

use clap::Parser;
use rigscape::commands::{TrainDitArgs, run_main, train_dit};

fn main() -> ExitCode {
    let args = TrainDitArgs::parse();
    run_main(|| train_dit(&args))
}
