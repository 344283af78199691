//! The transformer against stored numbers, and how it behaves.

mod behaviour;
mod golden;
mod official;
