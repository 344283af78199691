//! Integration tests of the BEV-VAE crate.

mod golden;
mod official;
