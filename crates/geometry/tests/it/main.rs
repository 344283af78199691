//! Parity with goldens: boxes to pixels in five datasets, and rigid-transform algebra.

mod golden;
mod projection;
mod rigid;
