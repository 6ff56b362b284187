//! Stage *project_backward*: gradients in the picture → gradients of the Gaussian and of the camera's pose.
//!
//! With Q = Σ₂⁻¹ and G = dL/dQ (symmetric): dL/dΣ₂ = −Q G Q, and since Σ₂ = m mᵀ + 0.3 I with m = J R · rot · S,
//! dL/dm = 2 (dL/dΣ₂) m. Everything else is the chain rule through m's three factors. Nothing is divided by det²:
//! Q is bounded by 1/0.3 because of the dilation.
//!
//! Pose: camera-space points move as p' = exp(ω) p + v. Then dL/dv = Σ dL/dp, dL/dω = Σ p × dL/dp + Σ r × dL/dr over
//! the columns r of R; the view direction of the SH sees v only (the camera centre moves by −Rᵀ v). With parallel rays it is
//! the last row of R.

use super::camera::{Camera, Rays};
use super::gaussian::Gaussian;
use super::project::{Culled, Limits, Projected, geometry};
use super::real::{Mat3, Real, Vec3, apply, apply_transposed, cross, dot, rotation_of_backward, sigmoid};
use super::shade::shade_backward;

/// dL/d of each field of [`Projected`].
pub type ProjectedGradient<R> = Projected<R>;

/// Gradient of one Gaussian and what it adds to the pose gradient (ω, v). `opacity_scale` as in
/// [`project`](super::project::project).
///
/// # Errors
/// The reason why the Gaussian was not drawn: it then has no gradient.
pub fn project_backward<R: Real>(
    g: &Gaussian<R>,
    camera: &Camera<R>,
    degree: u8,
    opacity_scale: R,
    limits: &Limits,
    upstream: &ProjectedGradient<R>,
) -> Result<(Gaussian<R>, [R; 6]), Culled> {
    let geo = geometry(g, camera, limits)?;
    let inverse_z = R::ONE / camera.divisor(geo.p[2]);
    let perspective = camera.rays == Rays::Perspective;
    let half = R::of(0.5);

    // Conic → Σ₂. The conic's xy entry stands for both off-diagonal entries.
    let q = [geo.cov[2] / geo.det, -geo.cov[1] / geo.det, geo.cov[0] / geo.det];
    let up = [upstream.conic[0], half * upstream.conic[1], upstream.conic[2]];
    let gq = [
        [up[0] * q[0] + up[1] * q[1], up[0] * q[1] + up[1] * q[2]],
        [up[1] * q[0] + up[2] * q[1], up[1] * q[1] + up[2] * q[2]],
    ];
    let h_xx = -(q[0] * gq[0][0] + q[1] * gq[1][0]);
    let h_xy = -(q[0] * gq[0][1] + q[1] * gq[1][1]);
    let h_yy = -(q[1] * gq[0][1] + q[2] * gq[1][1]);

    // Σ₂ → m → log scales, rotation, J R.
    let two = R::of(2.0);
    let dm: [[R; 3]; 2] = [
        std::array::from_fn(|k| two * (h_xx * geo.m[0][k] + h_xy * geo.m[1][k])),
        std::array::from_fn(|k| two * (h_xy * geo.m[0][k] + h_yy * geo.m[1][k])),
    ];
    let log_scale = std::array::from_fn(|k| {
        if geo.scale_active[k] { R::ZERO } else { dm[0][k] * geo.m[0][k] + dm[1][k] * geo.m[1][k] }
    });
    let dt: [[R; 3]; 2] = std::array::from_fn(|row| std::array::from_fn(|k| dm[row][k] * geo.scale[k]));
    let d_rotation: Mat3<R> =
        std::array::from_fn(|r| std::array::from_fn(|k| geo.jr[0][r] * dt[0][k] + geo.jr[1][r] * dt[1][k]));
    let rotation = rotation_of_backward(g.rotation, &d_rotation);
    let djr: [Vec3<R>; 2] = std::array::from_fn(|row| std::array::from_fn(|r| dot(geo.rotation[r], dt[row])));

    // J R → camera-space centre and camera rotation.
    let w = &camera.rotation;
    let mut dp = [R::ZERO; 3];
    let mut dw = [[R::ZERO; 3]; 3];
    for row in 0..2 {
        let f = camera.focal[row] * inverse_z;
        if perspective {
            dp[2] -= inverse_z * dot(geo.jr[row], djr[row]);
        }
        if perspective && !geo.clamp_active[row] {
            let dc = -f * dot(djr[row], w[2]);
            dp[row] += dc * inverse_z;
            dp[2] -= dc * geo.clamped[row] * inverse_z;
        }
        for k in 0..3 {
            dw[row][k] += f * djr[row][k];
            dw[2][k] -= f * geo.clamped[row] * djr[row][k];
        }
    }

    // Centre in the picture and depth.
    for row in 0..2 {
        let f = camera.focal[row] * inverse_z * upstream.mean2d[row];
        dp[row] += f;
        if perspective {
            dp[2] -= f * geo.p[row] * inverse_z;
        }
    }
    dp[2] += upstream.depth;

    let (sh, mut d_direction) = shade_backward(degree, camera.view_direction(g.mean), &g.sh, upstream.colour);
    if !perspective {
        // The direction is the camera's axis: it turns with the camera and moves with nothing.
        dw[2] = std::array::from_fn(|k| dw[2][k] + d_direction[k]);
        d_direction = [R::ZERO; 3];
    }
    let world = apply_transposed(w, dp);
    let mean = std::array::from_fn(|k| world[k] + d_direction[k]);

    let o = sigmoid(g.opacity_logit);
    let opacity_logit = upstream.opacity * opacity_scale * o * (R::ONE - o);

    let mut omega = cross(geo.p, dp);
    for k in 0..3 {
        let turn = cross([w[0][k], w[1][k], w[2][k]], [dw[0][k], dw[1][k], dw[2][k]]);
        omega = std::array::from_fn(|c| omega[c] + turn[c]);
    }
    let seen = apply(w, d_direction);
    let shift: Vec3<R> = std::array::from_fn(|k| dp[k] + seen[k]);
    let pose = [omega[0], omega[1], omega[2], shift[0], shift[1], shift[2]];
    Ok((Gaussian { mean, log_scale, rotation, opacity_logit, sh }, pose))
}
