//! Mixtures, batches and the loader on datasets of known content.

mod arrays;
mod clips;
mod fake;
mod order;
mod worlds;
