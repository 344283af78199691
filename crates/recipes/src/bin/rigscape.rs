//! Everything but training: data, checks, pictures.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use rigscape::commands::{
    ChangeRigArgs, CheckDataArgs, EncodeArgs, EvaluateArgs, ImportArgs, InfoArgs, LayoutCommandArgs, MakeDataArgs,
    NovelViewArgs, ReconstructArgs, ReplaceHistoryArgs, SampleArgs, ShowDataArgs, SweepGuidanceArgs, SynthesizeArgs,
    change_rig, check_data, encode, evaluate, import, info, layout, make_data, novel_view, reconstruct,
    replace_history, run_main, sample, show_data, sweep_guidance, synthesize,
};

/// Multi-camera driving scenes on any camera rig; to train, run train-vae
#[derive(Debug, Parser)]
#[command(name = "rigscape", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    MakeData(MakeDataArgs),
    CheckData(CheckDataArgs),
    ShowData(ShowDataArgs),
    Layout(LayoutCommandArgs),
    ReplaceHistory(ReplaceHistoryArgs),
    Encode(Box<EncodeArgs>),
    Evaluate(Box<EvaluateArgs>),
    Import(ImportArgs),
    Info(InfoArgs),
    Reconstruct(ReconstructArgs),
    NovelView(NovelViewArgs),
    ChangeRig(ChangeRigArgs),
    Sample(SampleArgs),
    Synthesize(Box<SynthesizeArgs>),
    SweepGuidance(SweepGuidanceArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    run_main(|| match &cli.command {
        Command::MakeData(args) => make_data(args),
        Command::CheckData(args) => check_data(args),
        Command::ShowData(args) => show_data(args),
        Command::Layout(args) => layout(args),
        Command::ReplaceHistory(args) => replace_history(args),
        Command::Encode(args) => encode(args),
        Command::Evaluate(args) => evaluate(args),
        Command::Import(args) => import(args),
        Command::Info(args) => info(args),
        Command::Reconstruct(args) => reconstruct(args),
        Command::NovelView(args) => novel_view(args),
        Command::ChangeRig(args) => change_rig(args),
        Command::Sample(args) => sample(args),
        Command::Synthesize(args) => synthesize(args),
        Command::SweepGuidance(args) => sweep_guidance(args),
    })
}
