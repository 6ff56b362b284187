//! Maps of a scene: the reference system they are drawn in, their grid and how each block of it is seen, what ground they
//! cover and which pictures show it, what its heights are worth, and the files they become (Cloud-Optimised GeoTIFF, world file, preview).

pub mod check_points;
pub mod crs;
mod error;
pub mod extent;
pub mod files;
pub mod georef;
pub mod grid;
pub mod height_raster;
mod preview;
pub mod seen;
pub mod surface;
pub mod up;

pub use error::OrthoError;
