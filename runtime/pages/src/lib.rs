//! What people look at: the report of a job, the live page of a flight or a ground station, and the viewer of a scene. Each is
//! one file or one small server that asks no network for anything.

pub mod report;
pub mod viewer;
pub mod watch;
