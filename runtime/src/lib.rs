//! The order of work: capture, initialise, train, checkpoint, upload, aggregate, evaluate. Only this crate knows it.

#[cfg(feature = "lab")]
pub mod bench;
#[cfg(test)]
#[path = "../../tests/carpet.rs"]
mod carpet;
pub mod cli;
#[cfg(feature = "lab")]
pub mod demo;
pub mod error;
pub mod train_job;
