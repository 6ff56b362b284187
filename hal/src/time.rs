//! Clocks. Everything the autopilot says is kept on its own boot clock, where it is exact; only at the boundary is it
//! mapped onto the companion's monotonic clock, with a stated uncertainty.

pub mod boot;
pub mod map;
pub mod unix;

#[cfg(feature = "std")]
mod companion;

#[cfg(feature = "std")]
pub use companion::{ManualClock, MonotonicClock};
