//! Stage *project*: Gaussians in the world → ellipses, depths and colours in the picture.
//!
//! EWA splatting as in 3DGS (Zwicker 2001; Kerbl 2023): p = R m + t, Σ₂ = (J R) Σ (J R)ᵀ + 0.3 I, with
//! J = [[fx/z, 0, −fx·x̂/z], [0, fy/z, −fy·ŷ/z]] where x̂ = clamp(x/z), ŷ = clamp(y/z) keep the linearisation
//! within 1.3 × the frustum. Two things differ from 3DGS on purpose, and neither changes the picture:
//! the clamp is taken around the true principal point (as gsplat does), and det Σ₂ is a sum of squares
//! (Cauchy–Binet over the columns of J R S), so that it can be neither negative nor lost to cancellation.

use super::camera::{Camera, Rays};
use super::gaussian::Gaussian;
use super::real::{Mat3, Real, Vec3, apply, rotation_of, sigmoid};
use super::shade::shade;
use crate::constants::{ALPHA_MIN, FRUSTUM_MARGIN, LOW_PASS, NEAR, SCALE_LIMIT, TRANSMITTANCE_MIN};

/// Where the formulas are cut off. [`Limits::default`] is what the shaders use; gradient checks take
/// [`Limits::smooth`].
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Gaussians nearer than this are not drawn, metres.
    pub near: f64,
    /// Contributions below this are skipped.
    pub alpha_min: f64,
    /// A pixel is finished before its transmittance would fall below this.
    pub transmittance_min: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self { near: NEAR.into(), alpha_min: ALPHA_MIN.into(), transmittance_min: TRANSMITTANCE_MIN.into() }
    }
}

impl Limits {
    /// No cut-off, hence no jump anywhere: what central differences can be compared with.
    pub fn smooth() -> Self {
        Self { alpha_min: 0.0, transmittance_min: 0.0, ..Self::default() }
    }
}

/// A Gaussian as the rasteriser sees it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Projected<R> {
    /// Centre in the picture, pixels.
    pub mean2d: [R; 2],
    /// Σ₂⁻¹ as (xx, xy, yy), pixels⁻².
    pub conic: [R; 3],
    /// Peak α.
    pub opacity: R,
    /// Linear colour, ≥ 0.
    pub colour: Vec3<R>,
    /// Depth along the optical axis, metres.
    pub depth: R,
}

/// Why a Gaussian is not drawn in this view; counted, never silent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Culled {
    /// Some parameter is NaN or infinite, or the quaternion is zero.
    NotFinite,
    /// Nearer than the near plane or behind the camera.
    Near,
    /// Opacity below the α cut-off (or left out by DropGaussian).
    Transparent,
    /// Its ellipse misses the picture.
    Outside,
}

/// Everything [`project`] computes on the way that the backward pass needs again.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geometry<R> {
    /// Camera-space centre.
    pub p: Vec3<R>,
    /// x/z and y/z after the clamp.
    pub clamped: [R; 2],
    /// Whether the clamp was active.
    pub clamp_active: [bool; 2],
    /// Standard deviations after the cut-off.
    pub scale: Vec3<R>,
    /// Whether the cut-off was active.
    pub scale_active: [bool; 3],
    /// Own axes → world.
    pub rotation: Mat3<R>,
    /// J R (2 × 3).
    pub jr: [[R; 3]; 2],
    /// J R · rotation · S (2 × 3): Σ₂ = m mᵀ + dilation.
    pub m: [[R; 3]; 2],
    /// Σ₂ with dilation: xx, xy, yy.
    pub cov: [R; 3],
    /// det Σ₂.
    pub det: R,
}

pub(crate) fn geometry<R: Real>(g: &Gaussian<R>, camera: &Camera<R>, limits: &Limits) -> Result<Geometry<R>, Culled> {
    if !g.is_sound() {
        return Err(Culled::NotFinite);
    }
    let r = apply(&camera.rotation, g.mean);
    let p: Vec3<R> = std::array::from_fn(|k| r[k] + camera.translation[k]);
    // Written so that NaN fails: an overflowing product of finite numbers is culled here.
    if !(p[2] > R::of(limits.near) && p.iter().all(|v| v.is_finite())) {
        return Err(Culled::Near);
    }
    let inverse_z = R::ONE / camera.divisor(p[2]);
    let (low, high) = camera.clamp_range(FRUSTUM_MARGIN.into());
    let raw = [p[0] * inverse_z, p[1] * inverse_z];
    let clamped: [R; 2] = std::array::from_fn(|k| raw[k].max(low[k]).min(high[k]));
    let clamp_active = std::array::from_fn(|k| raw[k] < low[k] || raw[k] > high[k]);
    let focal = [camera.focal[0] * inverse_z, camera.focal[1] * inverse_z];
    let jr: [[R; 3]; 2] = std::array::from_fn(|row| {
        std::array::from_fn(|k| focal[row] * (camera.rotation[row][k] - clamped[row] * camera.rotation[2][k]))
    });
    let rotation = rotation_of(g.rotation);
    let across = match camera.rays {
        Rays::Perspective => p[2],
        Rays::Orthographic => R::of(camera.size[0].into()) / camera.focal[0],
    };
    let scale_max = R::of(SCALE_LIMIT.into()) * across;
    let raw_scale = g.log_scale.map(|v| v.min(R::of(80.0)).exp());
    let scale = raw_scale.map(|v| v.min(scale_max));
    let scale_active = std::array::from_fn(|k| raw_scale[k] > scale_max);
    let m: [[R; 3]; 2] = std::array::from_fn(|row| {
        std::array::from_fn(|k| {
            (jr[row][0] * rotation[0][k] + jr[row][1] * rotation[1][k] + jr[row][2] * rotation[2][k]) * scale[k]
        })
    });
    let d = R::of(LOW_PASS.into());
    let xx = m[0][0] * m[0][0] + m[0][1] * m[0][1] + m[0][2] * m[0][2];
    let xy = m[0][0] * m[1][0] + m[0][1] * m[1][1] + m[0][2] * m[1][2];
    let yy = m[1][0] * m[1][0] + m[1][1] * m[1][1] + m[1][2] * m[1][2];
    let minor = |i: usize, j: usize| m[0][i] * m[1][j] - m[0][j] * m[1][i];
    let (a, b, c) = (minor(0, 1), minor(0, 2), minor(1, 2));
    // det(m mᵀ + d I) = Σ minors² + d·trace + d².
    let det = a * a + b * b + c * c + d * (xx + yy) + d * d;
    if !(det.is_finite() && det > R::ZERO && raw.iter().all(|v| v.is_finite())) {
        return Err(Culled::NotFinite);
    }
    Ok(Geometry { p, clamped, clamp_active, scale, scale_active, rotation, jr, m, cov: [xx + d, xy, yy + d], det })
}

/// Projects one Gaussian. `opacity_scale` is DropGaussian's factor: 0 drops it, 1/(1 − γ) raises it, 1 is no-op.
///
/// # Errors
/// The reason why it is not drawn.
pub fn project<R: Real>(
    g: &Gaussian<R>,
    camera: &Camera<R>,
    degree: u8,
    opacity_scale: R,
    limits: &Limits,
) -> Result<Projected<R>, Culled> {
    let geo = geometry(g, camera, limits)?;
    let opacity = sigmoid(g.opacity_logit) * opacity_scale;
    if opacity <= R::ZERO || opacity < R::of(limits.alpha_min) {
        return Err(Culled::Transparent);
    }
    let v = camera.view_direction(g.mean);
    let norm = super::real::dot(v, v).sqrt();
    let colour = shade(degree, v.map(|k| k / norm), &g.sh);
    let inverse_det = R::ONE / geo.det;
    let conic = [geo.cov[2] * inverse_det, -geo.cov[1] * inverse_det, geo.cov[0] * inverse_det];
    let mean2d: [R; 2] =
        std::array::from_fn(|k| camera.focal[k] * geo.p[k] / camera.divisor(geo.p[2]) + camera.principal[k]);
    let projected = Projected { mean2d, conic, opacity, colour, depth: geo.p[2] };
    if limits.alpha_min > 0.0 && !projected.touches(camera, &geo.cov, limits) {
        return Err(Culled::Outside);
    }
    Ok(projected)
}

impl<R: Real> Projected<R> {
    /// dᵀ Σ₂⁻¹ d ≤ this wherever α ≥ the cut-off: 2 ln(opacity / cut-off).
    pub fn reach(&self, limits: &Limits) -> R {
        if limits.alpha_min <= 0.0 {
            return R::of(f64::INFINITY);
        }
        R::of(2.0) * (self.opacity / R::of(limits.alpha_min)).ln()
    }

    /// Half the width and height of the axis-parallel box around the ellipse in which α ≥ the cut-off, pixels.
    pub fn half_extent(&self, cov: &[R; 3], limits: &Limits) -> [R; 2] {
        let reach = self.reach(limits).max(R::ZERO);
        [(reach * cov[0]).sqrt(), (reach * cov[2]).sqrt()]
    }

    fn touches(&self, camera: &Camera<R>, cov: &[R; 3], limits: &Limits) -> bool {
        let half = self.half_extent(cov, limits);
        (0..2).all(|k| {
            self.mean2d[k] + half[k] >= R::ZERO && self.mean2d[k] - half[k] <= R::of(f64::from(camera.size[k]))
        })
    }
}
