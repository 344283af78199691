//! Tests across crates: the house's rules, the shipped configs, and the programs as a user runs them.

mod architecture;
mod configs;
mod data_commands;
mod dit_runs;
mod evaluate;
mod latent_runs;
mod programs;
mod runs;
mod sensitivity;
mod synthesis;
