//! What is measured on maps of heights, each number with its standard deviation.
//!
//! [`accuracy`] is what check points say of a map, [`heights`] a part of a map in memory, [`noise`] what its heights are worth, [`areas`]
//! the polygons that people draw, [`base`] the ground below a heap, [`volume`] how much lies between the two, [`contours`] lines of equal
//! height, [`change`] what differs between two maps.

pub mod accuracy;
pub mod areas;
pub mod base;
pub mod change;
pub mod contours;
mod error;
pub mod heights;
pub mod noise;
pub mod volume;
mod written;

pub use error::MeasureError;
