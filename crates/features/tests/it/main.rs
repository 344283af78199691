//! Parity of the frozen networks with reference outputs, and their behaviour under automatic differentiation.

mod golden;
mod vgg16;
