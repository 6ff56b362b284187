//! Bytes moved and operations per stage, counted from the kernels' own layout: what a measured time is held against.
//!
//! Bytes are what a stage must read and write once at least (caches may serve some of it); operations are arithmetic
//! instructions of the kernels, an exponential counted as 15 (lavapipe's polynomial).

use super::Stage;

/// What a step worked on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Load {
    /// Gaussians on the device.
    pub gaussians: u64,
    /// Gaussians in view.
    pub visible: u64,
    /// Gaussian–tile instances.
    pub instances: u64,
    /// Gaussian–pixel evaluations of the forward blend.
    pub evaluations: u64,
    /// Pixels of the picture.
    pub pixels: u64,
    /// vec4 per Gaussian that hold its SH coefficients (see [`config::plan::sh_columns`]).
    pub sh_columns: u64,
}

/// What a stage costs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Bytes read and written.
    pub bytes: u64,
    /// Arithmetic operations.
    pub operations: u64,
}

/// Work of one stage in one step.
pub fn work(stage: Stage, load: &Load) -> Work {
    let Load { gaussians: n, visible: v, instances: m, evaluations: e, pixels: p, sh_columns: c } = *load;
    let (bytes, operations) = match stage {
        // RGBA8 in, colour and depth out.
        Stage::Target => (12 * p, 20 * p),
        // Three vec4 in; key out, three vec4 out for the visible.
        Stage::Project => (52 * n + 48 * v, 260 * n),
        // Four passes: key twice, row once in; key and row out; the first pass reads all keys.
        Stage::Sort => (8 * n + 4 * 20 * v, 4 * 8 * v),
        // Keys, and of the visible the step they were last moved in; then their place, what was projected and SH in, three vec4 out.
        Stage::Shade => (4 * n + v * (16 + 52 + 48 + 16 * c), v * (60 + 24 * c)),
        Stage::Count => (v * 36 + 8 * m, v * 60 + 2 * m),
        Stage::Emit => (v * 44 + 20 * m, v * 60 + 6 * m),
        // List entry and three vec4 per instance; image and transmittance out.
        Stage::Rasterise => (56 * m + 20 * p, 38 * e),
        // Three maps of three vec4 written and read once each; 12 and 9 values through two 11-tap passes.
        Stage::Loss => (p * (24 + 6 * 48 + 40), p * (2 * 2 * 11 * (12 + 9) + 200)),
        Stage::RasteriseBackward => (104 * m + 32 * p, 75 * e),
        Stage::Reduce => (48 * m + 56 * v, 12 * m),
        // Three columns of SH state in and out with what a colour needs; sum and three vec4 of geometry in, its gradient out; that and
        // nine vec4 of geometry in, the latter out again.
        Stage::Optimise => (v * (84 + 6 * 16 * c + 148 + 52 + 2 * 144), v * (560 + 14 * (12 + 4 * c))),
    };
    Work { bytes, operations }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_grows_with_what_the_stage_loops_over_and_with_nothing_else() {
        let load = Load { gaussians: 10, visible: 5, instances: 100, evaluations: 1600, pixels: 64, sh_columns: 12 };
        let more_pixels = Load { pixels: 128, ..load };
        let more_instances = Load { instances: 200, ..load };
        assert_eq!(work(Stage::Loss, &more_pixels).bytes, 2 * work(Stage::Loss, &load).bytes);
        assert_eq!(work(Stage::Loss, &more_instances), work(Stage::Loss, &load));
        assert_eq!(work(Stage::Optimise, &more_pixels), work(Stage::Optimise, &load));
        assert!(work(Stage::Reduce, &more_instances).bytes > work(Stage::Reduce, &load).bytes);
    }
}
