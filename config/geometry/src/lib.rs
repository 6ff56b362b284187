//! Geometry that every crate needs: positions on the Earth, lenses, polygons, and the median of measurements.
//!
//! Without the `std` feature only [`geodesy`] remains; the `no_std` core of `hal` uses it.
#![cfg_attr(not(feature = "std"), no_std)]

pub mod geodesy;
#[cfg(feature = "std")]
pub mod lens;
#[cfg(feature = "std")]
mod median;
#[cfg(feature = "std")]
pub mod polygon;

#[cfg(feature = "std")]
pub use median::median;
