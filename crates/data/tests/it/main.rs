//! Tests of the data crate that need files, threads or worlds; one binary, because linking is slow.

mod archives;
mod argoverse2;
mod clips;
mod colmap;
mod export;
mod fuzzed;
mod generated;
mod latents;
mod layout;
mod listed;
mod loader;
mod npz;
mod nuplan;
mod nuscenes;
mod occupancy;
mod procedural;
mod sampling;
mod waymo;
mod wayvescenes;
mod writer;
