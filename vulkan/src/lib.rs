//! The renderer and the fixed-memory trainer: Vulkan compute over one device allocation.
//!
//! [`gpu::Gpu`] opens a device, [`config::plan::Plan`] says what is allocated, [`trainer::Trainer`] trains and renders.

mod arena;
pub mod calibration;
#[cfg(feature = "lab")]
pub mod cases;
pub mod ceiling;
mod commands;
pub mod constants;
pub mod gpu;
mod kernels;
mod layout;
mod pipelines;
pub mod shape;
pub mod stages;
pub mod synthetic;
pub mod trainer;
pub mod twin;
