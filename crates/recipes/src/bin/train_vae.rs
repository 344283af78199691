//! Trains BEV-VAE.

use std::process::ExitCode;

use clap::Parser;
use rigscape::commands::{TrainVaeArgs, run_main, train_vae};

fn main() -> ExitCode {
    let args = TrainVaeArgs::parse();
    run_main(|| train_vae(&args))
}
