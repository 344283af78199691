//! Tests of the data crate that need files, threads or worlds; one binary, because linking is slow.

mod loader;
mod nuplan;
mod nuscenes;
mod writer;
