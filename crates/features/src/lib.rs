//! Frozen networks that losses, metrics and rewards look through.

mod vgg16;

pub use vgg16::{Preprocessing, Tap, Vgg16};
