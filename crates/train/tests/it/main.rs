//! Everything of `train` that needs files or a whole run: parity with PyTorch, exact resume, damaged checkpoints.

mod checkpoints;
mod ema_adamw;
mod gradients;
mod resume;
mod runs;
mod toy;
