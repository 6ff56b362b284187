//! What every job has, whatever it does: log lines and progress, a trace, an output folder of its own, `run.json`, signals,
//! bounds on memory, the state of the board, and the service manager.

pub mod console;
pub mod health;
pub mod interrupt;
pub mod resources;
pub mod run_json;
pub mod service;
pub mod session;
pub mod trace;

/// The crates of this workspace, by the targets of their log lines.
pub const CRATES: [&str; 11] =
    ["runtime", "engine", "flight", "ground", "job", "pages", "uplink", "vulkan", "models", "hal", "config"];
