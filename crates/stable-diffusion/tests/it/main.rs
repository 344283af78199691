//! Integration tests of the latent diffusion networks.

mod text;
