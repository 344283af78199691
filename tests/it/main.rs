//! Tests across crates: the house's rules, the shipped configs, and the programs as a user runs them.

mod architecture;
mod bev_vae;
mod configs;
mod data_commands;
mod dit_place;
mod dit_runs;
mod evaluate;
mod import;
mod latent_runs;
#[path = "../../crates/vae/tests/it/lightning.rs"]
mod lightning;
mod programs;
mod runs;
mod sensitivity;
mod synthesis;
