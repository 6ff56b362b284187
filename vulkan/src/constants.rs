//! Numbers that the shaders and their CPU references must share; `shaders/constants.glsl` holds the same values and a
//! test compares the two files, so that neither can drift alone.

/// Variance in px² added to both diagonal entries of the projected covariance (3DGS, `computeCov2D`).
pub const LOW_PASS: f32 = 0.3;
/// Largest opacity of one Gaussian in one pixel (gsplat's `MAX_ALPHA`); keeps 1/(1−α) ≤ 1000 in the backward.
pub const ALPHA_MAX: f32 = 0.999;
/// A Gaussian weaker than this in a pixel is not blended (3DGS).
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// Blending stops before the Gaussian that would push the transmittance below this (3DGS).
pub const TRANSMITTANCE_MIN: f32 = 1.0e-4;
/// Nearest depth that is projected, in world units, unless the frame says otherwise (gsplat).
pub const NEAR: f32 = 0.01;
/// x/z and y/z in the Jacobian are clamped to the picture's edge plus this share of the half field of view
/// (width/2/fx), as gsplat does for off-centre principal points.
pub const FRUSTUM_MARGIN: f32 = 0.3;
/// Standard deviations are clamped to this many times the camera depth before projecting, with zero gradient beyond:
/// already flat over any picture, and every product stays finite in f32 (log scales up to 40 stay visible).
pub const SCALE_LIMIT: f32 = 1.0e4;
/// Colours above this are clamped, with zero gradient, so that f32::MAX coefficients cannot overflow a sum.
pub const COLOUR_MAX: f32 = 1.0e3;
/// SSIM stabilisers for a dynamic range of 1 (Wang et al. 2004).
pub const SSIM_C1: f32 = 0.0001;
/// See [`SSIM_C1`].
pub const SSIM_C2: f32 = 0.0009;
/// Half width of SSIM's 11-tap Gaussian window; outside the picture counts as zero, as in 3DGS.
pub const SSIM_RADIUS: usize = 5;
/// The window of standard deviation 1.5, from the centre outwards, summing to one over all 11 taps.
pub const SSIM_WINDOW: [f32; 6] =
    [0.266_011_72, 0.213_005_53, 0.109_360_69, 0.036_000_773, 0.007_598_758, 0.001_028_380_1];
/// Pixels of a strip: what a lane of the loss kernels works on.
pub const STRIP: u32 = 8;
/// Pixels of a strip whose sums a lane holds at once where registers are few. Two: Mali spills none then, and 376/539 with all
/// eight (tests/data/boards.md).
pub const SHORT_PART: u32 = 2;
/// Variance added to both Pearson variances, in units of the prior's variance: constant depth gives no gradient.
pub const PEARSON_EPSILON: f32 = 1.0e-6;
/// Adam's β₁ (Kingma & Ba 2015; 3DGS).
pub const ADAM_BETA1: f32 = 0.9;
/// Adam's β₂.
pub const ADAM_BETA2: f32 = 0.999;
/// Adam's ε (3DGS).
pub const ADAM_EPSILON: f32 = 1.0e-15;
/// Width of a tile in pixels. One shader invocation blends one tile, or a run of it. On lavapipe a step of fox with 10,756
/// Gaussians took 90 ms of processor time with tiles of 4×4, 72 with 8×4 and 64 with 8×8; with ten times the Gaussians 206,
/// 195 and 195 (what each instance costs against what each pixel of a larger tile does).
pub const TILE_WIDTH: u32 = 8;
/// Height of a tile in pixels.
pub const TILE_HEIGHT: u32 = 4;
/// Neighbouring pixels of a tile that are summed first; a lane's share where several blend a tile.
pub const RUN: u32 = 4;
/// Tiles across and down of a block: the order in which a whole window is blended.
pub const BLOCK: [u32; 2] = [2, 4];
/// Runs of a tile.
pub const RUNS: u32 = TILE_WIDTH * TILE_HEIGHT / RUN;
/// An SH coefficient is penalised by its square below about this, by its size above it. Times a basis function (0.5) half a grey level of
/// 256.
pub const SH_SMALL: f32 = 0.004;
/// Real spherical harmonics: Y₀₀.
pub const SH_C0: f32 = 0.282_094_79;
/// Degree 1.
pub const SH_C1: f32 = 0.488_602_51;
/// Degree 2.
pub const SH_C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
/// Degree 3.
pub const SH_C3: [f32; 7] =
    [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_34, -0.457_045_8, 1.445_305_7, -0.590_043_6];
