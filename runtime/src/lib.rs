//! The order of work: capture, initialise, train, checkpoint, upload, aggregate, evaluate. Only this crate knows it.

pub mod aggregate;
#[cfg(feature = "lab")]
pub mod bench;
pub mod capture;
pub mod cli;
pub mod coverage;
#[cfg(feature = "lab")]
pub mod demo;
pub mod error;
pub mod fly;
pub mod keyframe_store;
#[cfg(test)]
#[path = "../../tests/power_cut/mod.rs"]
mod power_cut;
#[cfg(test)]
#[path = "../../tests/bad_link.rs"]
#[allow(dead_code, reason = "all of it is used where links are tested")]
mod bad_link;
#[cfg(test)]
#[path = "../../tests/carpet.rs"]
mod carpet;
pub mod serve;
pub mod train_job;
