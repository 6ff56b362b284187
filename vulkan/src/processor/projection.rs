//! Projection of one Gaussian, shared by `project` and `project_backward`: gsplat's EWA splatting, with the determinant as a sum of squares
//! (Cauchy-Binet), which stays positive where a c - b b cancels (`shaders/projection.glsl`; reference: `crate::reference::project`).

use super::gaussians::Vec4;
use crate::constants::{LOW_PASS, SCALE_LIMIT};
use crate::layout::{FLAG_ORTHOGRAPHIC, Frame};
use glam::{BVec2, BVec3, Mat3, Vec2, Vec3};

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

/// A Gaussian in the picture, and what its gradient needs again.
pub(super) struct Projection {
    /// In the camera's axes.
    pub p: Vec3,
    /// Depth; 1 in an orthographic view.
    pub divisor: f32,
    /// x/z and y/z clamped for the Jacobian.
    pub ratio: Vec2,
    pub clamped: BVec2,
    pub scale_clamped: BVec3,
    /// Scaled axes in the camera's.
    pub axes: [Vec3; 3],
    /// Projected axes, x and y, pixels.
    pub a: Vec3,
    pub b: Vec3,
    /// xx, xy, yy with the low-pass.
    pub cov: [f32; 3],
    pub det: f32,
    /// Length of the quaternion.
    pub q_length: f32,
}

/// Own axes to the world's, of a unit quaternion w x y z.
#[inline(always)]
fn rotation_of([w, x, y, z]: Vec4) -> Mat3 {
    Mat3::from_cols(
        Vec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        Vec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        Vec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
}

/// A quaternion's length, never zero.
#[inline(always)]
pub(super) fn length(q: Vec4) -> f32 {
    (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt().max(1.0e-20)
}

impl Projection {
    /// Projects a Gaussian in front of the camera. In an orthographic view nothing is divided by depth: J = [[fx, 0, 0], [0, fy, 0]], f in
    /// pixels per metre.
    #[inline(always)]
    pub fn of(camera: &Camera, place: Vec4, log_scale: Vec4, rotation: Vec4) -> Self {
        let p = camera.point(three(place));
        let divisor = if camera.orthographic { 1.0 } else { p.z };
        let inverse_z = 1.0 / divisor;
        let wanted = if camera.orthographic { Vec2::ZERO } else { Vec2::new(p.x, p.y) * inverse_z };
        let ratio = wanted.max(camera.ratios[0]).min(camera.ratios[1]);
        let q_length = length(rotation);
        let own = rotation_of(rotation.map(|v| v / q_length));
        let limit = SCALE_LIMIT * if camera.orthographic { camera.across } else { p.z };
        let raw = three(log_scale).min(Vec3::splat(80.0));
        let raw = Vec3::new(raw.x.exp(), raw.y.exp(), raw.z.exp());
        let scale = raw.min(Vec3::splat(limit));
        let axes = [
            camera.turned(own.x_axis) * scale.x,
            camera.turned(own.y_axis) * scale.y,
            camera.turned(own.z_axis) * scale.z,
        ];
        let f = camera.focal * inverse_z;
        let [ax, ay, az] = [0, 1, 2].map(|i| Vec3::new(axes[0][i], axes[1][i], axes[2][i]));
        let (a, b) = (f.x * (ax - ratio.x * az), f.y * (ay - ratio.y * az));
        let (aa, bb, c) = (a.dot(a), b.dot(b), a.cross(b));
        Self {
            p,
            divisor,
            ratio,
            clamped: wanted.cmpne(ratio),
            scale_clamped: raw.cmpgt(Vec3::splat(limit)),
            axes,
            a,
            b,
            cov: [aa + LOW_PASS, a.dot(b), bb + LOW_PASS],
            det: c.dot(c) + LOW_PASS * (aa + bb) + LOW_PASS * LOW_PASS,
            q_length,
        }
    }

    /// The inverse covariance: xx, xy, yy.
    #[inline(always)]
    pub fn conic(&self) -> [f32; 3] {
        let inverse = 1.0 / self.det;
        [self.cov[2] * inverse, -self.cov[1] * inverse, self.cov[0] * inverse]
    }
}
