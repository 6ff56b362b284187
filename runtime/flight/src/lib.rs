//! The onboard job: key frames chosen and kept, the flight's ground and what it lacks, and a model trained of it while it flies.

pub mod capture;
pub mod coverage;
pub mod error;
pub mod fly;
pub mod keyframe_store;
#[cfg(all(test, feature = "lab"))]
#[path = "../../../tests/power_cut/mod.rs"]
mod power_cut;
