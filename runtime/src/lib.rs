//! The order of work: capture, initialise, train, checkpoint, upload, aggregate, evaluate. Only this crate knows it.

pub mod aggregate;
#[cfg(feature = "lab")]
pub mod bench;
pub mod cli;
#[cfg(feature = "lab")]
pub mod demo;
pub mod error;
#[cfg(test)]
#[path = "../../tests/bad_link.rs"]
#[allow(dead_code, reason = "all of it is used where links are tested")]
mod bad_link;
#[cfg(test)]
#[path = "../../tests/carpet.rs"]
mod carpet;
pub mod serve;
pub mod train_job;
