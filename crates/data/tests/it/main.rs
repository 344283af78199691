//! Tests of the data crate that need files, threads or worlds; one binary, because linking is slow.

mod colmap;
mod loader;
mod npz;
mod nuplan;
mod nuscenes;
mod occupancy;
mod procedural;
mod waymo;
mod wayvescenes;
mod writer;
