//! Gaussian cloud, cameras and file formats; ONNX sessions, pose refinement, global alignment and the
//! initialisation that turns posed pictures into Gaussians.
//!
//! World frame: local ENU metres around a WGS-84 origin. Cameras: OpenCV axes (x right, y down, z forward).
//! Pixel convention: the centre of the top-left pixel is (0.5, 0.5), as COLMAP's.

pub mod align;
pub mod baselines;
pub mod camera;
pub mod cloud;
pub mod formats;
mod frame_file;
pub mod ground_cell;
pub mod init;
pub mod levels;
pub mod light;
pub mod mask;
pub mod metrics;
mod morton;
pub mod onnx;
pub mod picture;
pub mod refine;
pub mod undistort;
