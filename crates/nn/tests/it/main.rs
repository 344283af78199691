//! Tests of the public surface against files that others wrote.

mod torch;
mod torch_broken;
