//! Parity with the reference implementations named in each golden's README.

mod detection;
mod distances;
mod golden;
mod pictures;
