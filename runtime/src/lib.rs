//! The order of work: capture, initialise, train, checkpoint, upload, aggregate, evaluate. Only this crate knows it.

pub mod aggregate;
#[cfg(feature = "lab")]
pub mod bench;
pub mod capture;
pub mod cli;
pub mod cost;
pub mod coverage;
#[cfg(feature = "lab")]
pub mod demo;
pub mod devices;
pub mod engine;
pub mod error;
pub mod evaluate;
pub mod failsafe;
pub mod fly;
pub mod kernels;
pub mod keyframe_store;
pub mod ortho;
#[cfg(test)]
#[path = "../../tests/power_cut/mod.rs"]
mod power_cut;
#[cfg(test)]
#[path = "../../tests/bad_link.rs"]
#[allow(dead_code, reason = "all of it is used where links are tested")]
mod bad_link;
pub mod preset;
pub mod report;
pub mod serve;
pub mod train_job;
pub mod transfer;
pub mod viewer;
pub mod watch;
