//! Every reader of `runtime` against broken input: what comes over the wire or on a stick, and what a restart reads back.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/readers/driver.rs"]
mod driver;
#[path = "readers/state.rs"]
mod state;
#[path = "readers/wire.rs"]
mod wire;
