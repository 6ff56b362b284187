//! `bench`: run time against error, memory, numerical stress and every skip, measured by the program itself, so that
//! each figure of `tests/BENCHMARKS.md` has a command that makes it anew.

#[cfg(test)]
#[path = "../../carpet.rs"]
mod carpet;
pub mod child;
pub mod cli;
pub mod csv;
pub mod detail;
pub mod forecast;
pub mod front;
pub mod frustum;
pub mod ground;
pub mod levels;
pub mod map;
pub mod memory;
pub mod methods;
pub mod poses;
pub mod scene;
pub mod skips;
pub mod sparse;
pub mod stages;
pub mod stress;
pub mod time_error;
