//! How many lanes share the work of a step, by kind of device.

use serde::Serialize;

/// Lanes of the kernels whose number does not follow from the picture or the scene. How many sort says nothing about the result; the
/// pose's gradient is summed in as many parts as there are lanes that loop, and rounded accordingly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Lanes {
    /// Lanes that sort, count and emit, each its share of the Gaussians. Every lane more is one more histogram to clear, fill and sum
    /// (128 instead of 32: counting and sorting took 1.4 times as long on lavapipe).
    pub sort: u32,
    /// Lanes of the passes that loop over the visible Gaussians; each leaves one partial sum, which the host reads.
    pub loops: u32,
}

impl Lanes {
    /// A processor: enough to keep the cores of a small board busy.
    pub const SOFTWARE: Self = Self { sort: 32, loops: 1024 };
    /// A board's GPU, whose many slow lanes would stand idle (chosen by counting: V3D holds 768 lanes at once).
    pub const BOARD: Self = Self { sort: 256, ..Self::SOFTWARE };
    /// A card, which holds a hundred thousand lanes at once.
    pub const CARD: Self = Self { loops: 1 << 14, ..Self::BOARD };
}
