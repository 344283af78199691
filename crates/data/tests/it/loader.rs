//! Mixtures, batches and the loader on datasets of known content.

mod arrays;
mod fake;
mod order;
mod worlds;
