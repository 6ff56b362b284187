//! CPU references of the stages, in plain Rust, over f32 or f64: `project`, `sort`, `emit` (counting included), `shade`,
//! `rasterise`, `loss`, `rasterise_backward` (with `reduce`: a reference sums at once), and of `optimise` the parts
//! `project_backward`, `entropy`, `view_dependence` and `adam`. The stage `target` has none, and neither has density control, which runs on the host.
//!
//! In f32 they say what the shaders should have computed; in f64 they are the judge of both: the gradient checks
//! compare them with central differences, and the parity test with the published formulas. They are
//! written to be read next to the papers, not to be fast.

pub mod adam;
pub mod camera;
pub mod emit;
pub mod entropy;
pub mod gaussian;
pub mod loss;
pub mod project;
pub mod project_backward;
pub mod rasterise;
pub mod real;
pub mod shade;
pub mod step;
pub mod trainer;
pub mod view_dependence;
