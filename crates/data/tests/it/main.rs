//! Tests of the data crate that need files, threads or worlds; one binary, because linking is slow.

mod archives;
mod argoverse2;
mod clips;
mod colmap;
mod fuzzed;
mod generated;
<<<<<<< HEAD
mod latents;
=======
mod layout;
>>>>>>> 95ba549888704b953e95777277df5e7bbdf963b4
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
