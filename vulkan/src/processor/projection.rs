//! Projection of eight Gaussians at a time, shared by `project` and `project_backward`: gsplat's EWA splatting, with the determinant as a sum of squares
//! (Cauchy-Binet), which stays positive where a c - b b cancels (`shaders/projection.glsl`; reference: `crate::reference::project`).

use super::gaussians::Vec4;
use super::lanes::{F8, exp, splat};
use super::vectors::V3;
use crate::constants::{LOW_PASS, SCALE_LIMIT};
use crate::layout::{FLAG_ORTHOGRAPHIC, Frame};
use fearless_simd::prelude::*;
use fearless_simd::{Simd, mask32x8};
use glam::{Vec2, Vec3};

/// The frame's camera.
#[derive(Clone, Copy)]
pub(super) struct Camera {
    rows: [Vec3; 3],
    translation: Vec3,
    pub center: Vec3,
    pub focal: Vec2,
    pub principal: Vec2,
    ratios: [Vec2; 2],
    pub orthographic: bool,
    /// Width of the picture in the world, where rays are parallel.
    across: f32,
}

impl Camera {
    pub fn of(frame: &Frame) -> Self {
        let r = &frame.view_rows;
        Self {
            rows: [0, 1, 2].map(|i| Vec3::new(r[i][0], r[i][1], r[i][2])),
            translation: Vec3::new(r[0][3], r[1][3], r[2][3]),
            center: Vec3::from_array(frame.camera_center),
            focal: Vec2::from_array(frame.focal),
            principal: Vec2::from_array(frame.principal_point),
            ratios: [frame.min_ratio, frame.max_ratio].map(Vec2::from_array),
            orthographic: frame.has(FLAG_ORTHOGRAPHIC),
            across: frame.size[0] as f32 / frame.focal[0],
        }
    }

    /// The direction of the optical axis in the world.
    pub fn axis(&self) -> Vec3 {
        self.rows[2]
    }

    /// A direction of the world in the camera's axes.
    #[inline(always)]
    pub fn turned(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.rows[0].dot(v), self.rows[1].dot(v), self.rows[2].dot(v))
    }

    /// A point of the world in the camera's axes.
    #[inline(always)]
    pub fn point(&self, p: Vec3) -> Vec3 {
        self.turned(p) + self.translation
    }

    /// A point's depth.
    #[inline(always)]
    pub fn depth(&self, p: Vec3) -> f32 {
        self.rows[2].dot(p) + self.translation.z
    }

    /// A direction of the camera in the world's axes.
    #[inline(always)]
    pub fn in_world(&self, v: Vec3) -> Vec3 {
        v.x * self.rows[0] + v.y * self.rows[1] + v.z * self.rows[2]
    }
}

/// The first three of four numbers.
#[inline(always)]
pub(super) fn three(v: Vec4) -> Vec3 {
    Vec3::new(v[0], v[1], v[2])
}

/// Three numbers and a fourth.
#[inline(always)]
pub(super) fn four(v: Vec3, w: f32) -> Vec4 {
    [v.x, v.y, v.z, w]
}

/// Eight Gaussians in the picture, and what their gradients need again.
pub(super) struct Projection<S: Simd> {
    /// In the camera's axes.
    pub p: V3<S>,
    /// Depth; 1 in an orthographic view.
    pub divisor: F8<S>,
    /// x/z and y/z clamped for the Jacobian.
    pub ratio: [F8<S>; 2],
    pub clamped: [mask32x8<S>; 2],
    pub scale_clamped: [mask32x8<S>; 3],
    /// Scaled axes in the camera's.
    pub axes: [V3<S>; 3],
    /// Projected axes, x and y, pixels.
    pub a: V3<S>,
    pub b: V3<S>,
    /// xx, xy, yy with the low-pass.
    pub cov: [F8<S>; 3],
    pub det: F8<S>,
    /// Length of the quaternion.
    pub q_length: F8<S>,
}

/// Own axes in the world's, of unit quaternions w x y z.
#[inline(always)]
fn axes_of<S: Simd>(s: S, [w, x, y, z]: [F8<S>; 4]) -> [V3<S>; 3] {
    let (one, two) = (splat(s, 1.0), splat(s, 2.0));
    [
        V3 { x: one - two * (y * y + z * z), y: two * (x * y + w * z), z: two * (x * z - w * y) },
        V3 { x: two * (x * y - w * z), y: one - two * (x * x + z * z), z: two * (y * z + w * x) },
        V3 { x: two * (x * z + w * y), y: two * (y * z - w * x), z: one - two * (x * x + y * y) },
    ]
}

/// A quaternion's length, never zero.
#[inline(always)]
pub(super) fn length(q: Vec4) -> f32 {
    (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt().max(1.0e-20)
}

impl<S: Simd> Projection<S> {
    /// Projects Gaussians in front of the camera: rows of place, log scale and rotation. In an orthographic view nothing is divided by
    /// depth: J = [[fx, 0, 0], [0, fy, 0]], f in pixels per metre.
    #[inline(always)]
    pub fn of(s: S, camera: &Camera, place: [F8<S>; 4], [lx, ly, lz, _]: [F8<S>; 4], q: [F8<S>; 4]) -> Self {
        /// Log scales beyond this are cut to it: their exponential is far beyond every limit.
        const MOST: f32 = 80.0;
        let (zero, one, low_pass) = (splat(s, 0.0), splat(s, 1.0), splat(s, LOW_PASS));
        let view = View::of(s, camera);
        let p = view.point(V3::of(place));
        let divisor = if camera.orthographic { one } else { p.z };
        let inverse_z = one / divisor;
        let (least, most) = (camera.ratios[0], camera.ratios[1]);
        let wanted = if camera.orthographic { [zero; 2] } else { [p.x * inverse_z, p.y * inverse_z] };
        let ratio_x = wanted[0].max(splat(s, least.x)).min(splat(s, most.x));
        let ratio_y = wanted[1].max(splat(s, least.y)).min(splat(s, most.y));
        let square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
        let q_length = square.sqrt().max(splat(s, 1.0e-20));
        let unit = one / q_length;
        let [own_x, own_y, own_z] = axes_of(s, [q[0] * unit, q[1] * unit, q[2] * unit, q[3] * unit]);
        let limit = if camera.orthographic { splat(s, SCALE_LIMIT * camera.across) } else { p.z * SCALE_LIMIT };
        let (rx, ry, rz) = (exp(lx.min(splat(s, MOST))), exp(ly.min(splat(s, MOST))), exp(lz.min(splat(s, MOST))));
        let axes = [
            view.turned(own_x).times(rx.min(limit)),
            view.turned(own_y).times(ry.min(limit)),
            view.turned(own_z).times(rz.min(limit)),
        ];
        let (fx, fy) = (inverse_z * camera.focal.x, inverse_z * camera.focal.y);
        let ax = V3 { x: axes[0].x, y: axes[1].x, z: axes[2].x };
        let ay = V3 { x: axes[0].y, y: axes[1].y, z: axes[2].y };
        let az = V3 { x: axes[0].z, y: axes[1].z, z: axes[2].z };
        let a = ax.plus(az.times(-ratio_x)).times(fx);
        let b = ay.plus(az.times(-ratio_y)).times(fy);
        let (aa, bb, c) = (a.dot(a), b.dot(b), a.cross(b));
        Self {
            p,
            divisor,
            ratio: [ratio_x, ratio_y],
            clamped: [!wanted[0].simd_eq(ratio_x), !wanted[1].simd_eq(ratio_y)],
            scale_clamped: [rx.simd_gt(limit), ry.simd_gt(limit), rz.simd_gt(limit)],
            axes,
            a,
            b,
            cov: [aa + low_pass, a.dot(b), bb + low_pass],
            det: c.dot(c) + low_pass * (aa + bb) + low_pass * low_pass,
            q_length,
        }
    }

    /// The inverse covariance: xx, xy, yy.
    #[inline(always)]
    pub fn conic(&self, s: S) -> [F8<S>; 3] {
        let inverse = splat(s, 1.0) / self.det;
        [self.cov[2] * inverse, -self.cov[1] * inverse, self.cov[0] * inverse]
    }
}

/// The camera's pose for eight Gaussians.
#[derive(Clone, Copy)]
pub(super) struct View<S: Simd> {
    rows: [V3<S>; 3],
    translation: V3<S>,
}

impl<S: Simd> View<S> {
    #[inline(always)]
    pub fn of(s: S, camera: &Camera) -> Self {
        let [x, y, z] = camera.rows;
        let rows = [V3::splat(s, x), V3::splat(s, y), V3::splat(s, z)];
        Self { rows, translation: V3::splat(s, camera.translation) }
    }

    /// Directions of the world in the camera's axes.
    #[inline(always)]
    pub fn turned(&self, v: V3<S>) -> V3<S> {
        V3 { x: self.rows[0].dot(v), y: self.rows[1].dot(v), z: self.rows[2].dot(v) }
    }

    /// Points of the world in the camera's axes.
    #[inline(always)]
    pub fn point(&self, p: V3<S>) -> V3<S> {
        self.turned(p).plus(self.translation)
    }
}
