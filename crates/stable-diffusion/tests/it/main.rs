//! Integration tests of the latent diffusion networks.

mod controlnet;
mod cross_view;
mod folder;
mod full_size;
mod golden;
mod lora;
mod segments;
mod single_file;
mod text;
mod unet;
mod vae;
