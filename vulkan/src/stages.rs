//! Names of the pipeline's stages, in order: timings, counters and the CPU references all use them.

pub mod work;

/// Target of the events that tell a stage's time by the device's clock: `stage` (its number), `ago_ns` before the event it began, and
/// `took_ns`. While somebody listens to them at level TRACE, every submission is timed.
pub const DEVICE_TIMES: &str = "device_times";

/// A stage of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// The step's picture at working size.
    Target,
    /// Culling and projection.
    Project,
    /// Depth sort of the visible Gaussians.
    Sort,
    /// Colour from spherical harmonics.
    Shade,
    /// Instances per tile and their prefix sums.
    Count,
    /// Instance lists per tile.
    Emit,
    /// Blending.
    Rasterise,
    /// Loss and its gradient at the pixels.
    Loss,
    /// The blend's gradient.
    RasteriseBackward,
    /// Sum of gradient slots per Gaussian.
    Reduce,
    /// Projection's gradient and Adam.
    Optimise,
}

/// Every stage, in pipeline order.
pub const STAGES: [Stage; 11] = [
    Stage::Target,
    Stage::Project,
    Stage::Sort,
    Stage::Shade,
    Stage::Count,
    Stage::Emit,
    Stage::Rasterise,
    Stage::Loss,
    Stage::RasteriseBackward,
    Stage::Reduce,
    Stage::Optimise,
];

/// Every stage's name, indexed by `Stage as usize`.
pub const STAGE_NAMES: [&str; 11] = [
    "target",
    "project",
    "sort",
    "shade",
    "count",
    "emit",
    "rasterise",
    "loss",
    "rasterise_backward",
    "reduce",
    "optimise",
];
