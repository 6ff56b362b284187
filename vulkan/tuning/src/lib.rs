//! What is known of a device before it trains: which kernel configuration is the fastest, what a step costs, and which of several
//! devices to take. Each is measured once and kept ([`cache`]).

pub mod autotune;
pub mod cache;
pub mod cost;
pub mod devices;
#[cfg(any(test, feature = "lab"))]
pub mod fixtures;
pub mod kernels;
pub mod loads;
pub mod model;
pub mod slopes;
