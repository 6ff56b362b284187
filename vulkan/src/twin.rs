//! CPU twins: every shader stage once more under the same name, in plain Rust, over f32 or f64. (Density control has
//! none: it runs on the host, in `trainer::density`.)
//!
//! In f32 they say what the shaders should have computed; in f64 they are the judge of both: the gradient checks
//! compare them with central differences, and the parity test with the published formulas. They are
//! written to be read next to the papers, not to be fast.

pub mod adam;
pub mod camera;
pub mod gaussian;
pub mod loss;
pub mod project;
pub mod project_backward;
pub mod rasterise;
pub mod real;
pub mod sh;
pub mod step;
pub mod tiles;
pub mod trainer;
