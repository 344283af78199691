//! Parity of the frozen networks with reference outputs, strict loading, and their behaviour under automatic differentiation.

mod common;
mod golden;
mod i3d;
mod inception;
mod known;
mod loftr;
mod lpips;
mod npz;
mod small_nets;
mod vgg16;
