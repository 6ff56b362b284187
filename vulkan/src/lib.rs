//! The renderer and the fixed-memory trainer: Vulkan compute over one device allocation.
//!
//! [`gpu::Gpu`] opens a device, [`config::plan::Plan`] says what is allocated, [`trainer::PictureStore`] holds the
//! pictures, [`trainer::Trainer`] trains and renders.

mod arena;
#[cfg(feature = "lab")]
pub mod cases;
mod commands;
pub mod constants;
mod device;
mod error;
#[cfg(any(test, feature = "lab"))]
pub mod fixture;
pub mod gpu;
pub mod kernel_config;
mod kernels;
mod layout;
mod model;
mod pictures;
mod pipelines;
mod processor;
pub mod reference;
pub mod roofline;
pub mod stages;
pub mod synthetic;
mod times;
pub mod trainer;
