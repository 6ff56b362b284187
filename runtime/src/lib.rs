//! The order of work: capture, initialise, train, checkpoint, upload, aggregate, evaluate. Only this crate knows it.

pub mod aggregate;
pub mod bench;
pub mod capture;
pub mod cli;
pub mod console;
pub mod demo;
pub mod evaluate;
pub mod fly;
pub mod interrupt;
pub mod kernels;
pub mod keyframe_store;
pub mod renderer;
pub mod report;
pub mod resources;
pub mod run_json;
pub mod serve;
pub mod train_job;
pub mod transfer;
pub mod upload;
