//! Golden tests of the tensor operations on the CPU backend, and agreement between backends.

mod attention;
mod backends;
mod golden;
mod sampling;
