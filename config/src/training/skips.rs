//! Work that a scene does not need, each kind with its switch. All of these are on: none changes the picture (the last two
//! change rounding only), and `dgtr bench skips` says what each is worth on a given device.

use serde::{Deserialize, Serialize};

/// Which work is skipped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SkipSettings {
    /// Gaussians outside the picture are neither sorted nor shaded.
    pub frustum: bool,
    /// Nor are those too transparent to show in any pixel.
    pub opacity: bool,
    /// A Gaussian is listed only for tiles that its ellipse touches, not for its whole bounding box.
    pub exact_tiles: bool,
    /// A tile is finished once every pixel is opaque.
    pub early_end: bool,
    /// Gaussians that a view does not see make up for the step when they are seen again, instead of in every step.
    pub deferred_moments: bool,
}

impl Default for SkipSettings {
    fn default() -> Self {
        Self { frustum: true, opacity: true, exact_tiles: true, early_end: true, deferred_moments: true }
    }
}
