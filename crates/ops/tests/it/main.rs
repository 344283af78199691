//! Golden tests of the tensor operations on the CPU backend, forward and gradients.

mod attention;
mod golden;
mod sampling;
