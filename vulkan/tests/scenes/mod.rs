//! The cases' own scenes, for the tests that need one of their own.
#![allow(unused_imports, reason = "each test binary uses its own part")]

pub mod device;
pub mod places;

pub use vulkan::cases::scenes::{Answer, answer, cloud, grey, photo, view};
