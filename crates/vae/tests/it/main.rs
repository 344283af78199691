//! Integration tests of the BEV-VAE crate.

mod behaviour;
mod golden;
mod lightning;
mod official;
mod released;
mod segmented;
