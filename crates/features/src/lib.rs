//! Frozen networks that losses, metrics and rewards look through.

mod conv;
mod efficientnet;
mod frozen;
mod i3d;
mod inception;
mod known;
mod loftr;
mod lpips;
mod squeezenet;
mod vgg16;

pub use efficientnet::{EFFICIENTNET_SIZE, EfficientNetLite0};
pub use i3d::{I3D_MIN_FRAMES, I3D_SIZE, I3d, I3dEpsilon, I3dFeatures};
pub use inception::{INCEPTION_SIZE, Inception, InceptionMaps, InceptionWeights};
pub use known::{KNOWN_WEIGHTS, KnownWeights, MissingWeights, StandIn, known_weights, require};
pub use loftr::{LOFTR_CELL, Loftr, LoftrMatch, MatchRules, mutual_matches};
pub use lpips::{Lpips, LpipsBackbone};
pub use ops::{PixelCentres, resize_bilinear};
pub use squeezenet::SqueezeNet;
pub use vgg16::{Preprocessing, Tap, Vgg16};
