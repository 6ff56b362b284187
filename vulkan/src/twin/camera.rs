//! The camera as the shaders take it: rows of world → camera, lens in pixels.

use models::camera::View;

use super::real::{Mat3, Real, Vec3, apply, apply_transposed, cross};

/// A pinhole camera in OpenCV axes.
#[derive(Clone, Copy, Debug)]
pub struct Camera<R> {
    /// World → camera rotation.
    pub rotation: Mat3<R>,
    /// World → camera translation, metres.
    pub translation: Vec3<R>,
    /// Camera centre in the world, metres.
    pub center: Vec3<R>,
    /// fx, fy, pixels.
    pub focal: [R; 2],
    /// cx, cy, pixels.
    pub principal: [R; 2],
    /// Width, height.
    pub size: [u32; 2],
}

impl<R: Real> Camera<R> {
    /// The camera of a view.
    pub fn of(view: &View) -> Self {
        let i = &view.intrinsics;
        let r = view.pose.rotation.conjugate().normalize();
        let m = glam::DMat3::from_quat(r);
        let t = -(r * view.pose.center);
        let row = |k: usize| m.row(k).to_array().map(R::of);
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: t.to_array().map(R::of),
            center: view.pose.center.to_array().map(R::of),
            focal: [R::of(i.fx.into()), R::of(i.fy.into())],
            principal: [R::of(i.cx.into()), R::of(i.cy.into())],
            size: [i.width, i.height],
        }
    }

    /// The same camera in another number type.
    pub fn cast<S: Real>(&self) -> Camera<S> {
        let v = |a: Vec3<R>| a.map(|x| S::of(x.f64()));
        Camera {
            rotation: self.rotation.map(v),
            translation: v(self.translation),
            center: v(self.center),
            focal: self.focal.map(|x| S::of(x.f64())),
            principal: self.principal.map(|x| S::of(x.f64())),
            size: self.size,
        }
    }

    /// Least and greatest x/z and y/z at which the projection is linearised: the picture's edges plus
    /// `margin` half-widths (gsplat's form of 3DGS's 1.3 × tan(fov/2), exact for any principal point).
    pub fn clamp_range(&self, margin: f64) -> ([R; 2], [R; 2]) {
        let half = |k: usize| R::of(0.5 * f64::from(self.size[k])) / self.focal[k] * R::of(margin);
        let size = |k: usize| R::of(f64::from(self.size[k]));
        (
            std::array::from_fn(|k| -self.principal[k] / self.focal[k] - half(k)),
            std::array::from_fn(|k| (size(k) - self.principal[k]) / self.focal[k] + half(k)),
        )
    }

    /// The camera after the update `p' = exp(ω) p + v` of camera-space points, ξ = (ω, v): the pose
    /// parameterisation whose gradient the backward pass returns.
    pub fn moved(&self, xi: [R; 6]) -> Self {
        let omega = [xi[0], xi[1], xi[2]];
        let e = exp_so3(omega);
        let rotation = std::array::from_fn(|r| {
            std::array::from_fn(|c| {
                e[r][0] * self.rotation[0][c] + e[r][1] * self.rotation[1][c] + e[r][2] * self.rotation[2][c]
            })
        });
        let t = apply(&e, self.translation);
        let translation = std::array::from_fn(|k| t[k] + xi[3 + k]);
        let center = apply_transposed(&rotation, translation).map(|x| -x);
        Self { rotation, translation, center, ..*self }
    }
}

/// Rodrigues' formula, with its series near 0.
pub fn exp_so3<R: Real>(w: Vec3<R>) -> Mat3<R> {
    let theta2 = (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]).f64();
    let theta = theta2.sqrt();
    let (a, b) = if theta < 1e-4 {
        (1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0)
    } else {
        (theta.sin() / theta, (1.0 - theta.cos()) / theta2)
    };
    let column = |k: usize| {
        let mut unit = [R::ZERO; 3];
        unit[k] = R::ONE;
        let once = cross(w, unit);
        let twice = cross(w, once);
        std::array::from_fn::<R, 3, _>(|r| unit[r] + R::of(a) * once[r] + R::of(b) * twice[r])
    };
    let columns = [column(0), column(1), column(2)];
    std::array::from_fn(|r| std::array::from_fn(|c| columns[c][r]))
}
