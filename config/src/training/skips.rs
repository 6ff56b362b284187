//! Work that a scene does not need, each kind with its switch. All of these are on: none changes the picture (the last two
//! change rounding only), and `bench skips` says what each is worth on a given device.

use crate::settings::table;

table! {
    /// Work that is left out because it changes nothing.
    #[derive(Copy, Eq)]
    pub struct SkipSettings {
        /// Gaussians outside the picture are neither sorted nor shaded.
        pub frustum: bool = true;
        /// Gaussians too transparent to show in any pixel are neither sorted nor shaded.
        pub opacity: bool = true;
        /// A Gaussian is listed only for tiles that its ellipse touches, not for its whole bounding box.
        pub exact_tiles: bool = true;
        /// A tile is finished once every pixel is opaque.
        pub early_end: bool = true;
        /// Lazy Adam: Gaussians outside the view are updated for the step when they are seen again, instead of in every step.
        pub deferred_moments: bool = true;
    }
}
