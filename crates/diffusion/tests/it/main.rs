//! Samplers against stored trajectories and against distributions with known scores.

mod gaussian;
mod golden;
mod trajectories;
