//! The order of work: capture, initialise, train, checkpoint, upload, aggregate, evaluate. Only this crate knows it.

#[cfg(feature = "lab")]
pub mod child;
pub mod cli;
#[cfg(feature = "lab")]
pub mod demo;
#[cfg(feature = "lab")]
pub mod device_report;
pub mod error;
#[cfg(feature = "lab")]
pub mod figures;
pub mod survey_job;
pub mod train_job;
