//! The camera as the shaders take it: rows of world → camera, lens in pixels.

use models::camera::{OrthographicView, Pose, View};

use super::real::{Mat3, Real, Vec3, apply, apply_transposed, cross};

/// What a point's place in the picture is divided by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rays {
    /// Its depth: rays through the camera's centre.
    Perspective,
    /// Nothing: parallel rays along the optical axis, focal lengths in pixels per metre.
    Orthographic,
}

/// A camera in OpenCV axes.
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
    /// How it projects.
    pub rays: Rays,
}

impl<R: Real> Camera<R> {
    /// The camera of a view.
    pub fn of(view: &View) -> Self {
        let i = &view.intrinsics;
        Self {
            focal: [R::of(i.fx.into()), R::of(i.fy.into())],
            principal: [R::of(i.cx.into()), R::of(i.cy.into())],
            size: [i.width, i.height],
            ..Self::at(&view.pose, Rays::Perspective)
        }
    }

    /// The camera of an orthographic view.
    pub fn orthographic(view: &OrthographicView) -> Self {
        let size = [view.width, view.height];
        Self {
            focal: view.pixels_per_metre.map(R::of),
            principal: size.map(|n| R::of(0.5 * f64::from(n))),
            size,
            ..Self::at(&view.pose, Rays::Orthographic)
        }
    }

    fn at(pose: &Pose, rays: Rays) -> Self {
        let r = pose.rotation.conjugate().normalize();
        let m = glam::DMat3::from_quat(r);
        let t = -(r * pose.center);
        let row = |k: usize| m.row(k).to_array().map(R::of);
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: t.to_array().map(R::of),
            center: pose.center.to_array().map(R::of),
            focal: [R::ONE; 2],
            principal: [R::ZERO; 2],
            size: [0; 2],
            rays,
        }
    }

    /// What a point at this depth is divided by.
    pub fn divisor(&self, depth: R) -> R {
        match self.rays {
            Rays::Perspective => depth,
            Rays::Orthographic => R::ONE,
        }
    }

    /// Where the Gaussian at `mean` is seen along, not normalised.
    pub fn view_direction(&self, mean: Vec3<R>) -> Vec3<R> {
        match self.rays {
            Rays::Perspective => std::array::from_fn(|k| mean[k] - self.center[k]),
            Rays::Orthographic => self.rotation[2],
        }
    }

    /// This camera in another number type.
    pub fn cast<S: Real>(&self) -> Camera<S> {
        let v = |a: Vec3<R>| a.map(|x| S::of(x.f64()));
        Camera {
            rotation: self.rotation.map(v),
            translation: v(self.translation),
            center: v(self.center),
            focal: self.focal.map(|x| S::of(x.f64())),
            principal: self.principal.map(|x| S::of(x.f64())),
            size: self.size,
            rays: self.rays,
        }
    }

    /// Least and greatest x/z and y/z at which the projection is linearised: the picture's edges plus
    /// `margin` half-widths (gsplat's form of 3DGS's 1.3 × tan(fov/2), exact for any principal point). Zero for parallel
    /// rays: their Jacobian does not know depth.
    pub fn clamp_range(&self, margin: f64) -> ([R; 2], [R; 2]) {
        if self.rays == Rays::Orthographic {
            return ([R::ZERO; 2], [R::ZERO; 2]);
        }
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
