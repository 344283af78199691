//! Golden tests of the tensor operations on the CPU backend, and agreement between backends, properties of all operations.

mod attention;
mod backends;
mod cases;
mod golden;
mod memory;
mod properties;
mod sampling;
