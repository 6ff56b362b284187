//! The renderer and the fixed-memory trainer: Vulkan compute over one device allocation.
//!
//! [`gpu::Gpu`] opens a device, [`config::plan::Plan`] says what is allocated, [`trainer::Trainer`] trains and renders.

mod arena;
pub mod autotune;
#[cfg(feature = "lab")]
pub mod cases;
mod commands;
pub mod constants;
pub mod gpu;
pub mod kernel_config;
mod kernels;
mod layout;
mod pipelines;
pub mod reference;
pub mod roofline;
pub mod stages;
pub mod synthetic;
pub mod trainer;
