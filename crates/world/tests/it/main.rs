//! Invariants of the procedural world.

mod common;
mod determinism;
mod map;
mod motion;
mod occupancy;
mod rays;
