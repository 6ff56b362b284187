//! Projection through a posed pinhole and back: in f64 for geometry that is solved for, in f32 for inner loops over pixels.

use glam::{DVec2, DVec3, Mat3, Quat, Vec3};

use super::{Intrinsics, Pose, View};

/// A posed pinhole in f64.
#[derive(Clone, Copy, Debug)]
pub struct Pinhole {
    /// Camera → world.
    pub pose: Pose,
    /// Focal lengths, pixels.
    pub f: DVec2,
    /// Principal point, pixels.
    pub c: DVec2,
}

impl Pinhole {
    /// At a pose, the focal lengths times `focal_scale`.
    pub fn new(pose: Pose, k: &Intrinsics, focal_scale: f64) -> Self {
        let f = DVec2::new(k.fx.into(), k.fy.into()) * focal_scale;
        Self { pose, f, c: DVec2::new(k.cx.into(), k.cy.into()) }
    }

    /// World → camera axes.
    pub fn local(&self, world: DVec3) -> DVec3 {
        self.pose.rotation.conjugate() * (world - self.pose.center)
    }

    /// Camera axes → pixel; only meaningful for `p.z > 0`.
    pub fn pixel(&self, p: DVec3) -> DVec2 {
        p.truncate() / p.z * self.f + self.c
    }

    /// World → pixel, when in front.
    pub fn project(&self, world: DVec3) -> Option<DVec2> {
        let p = self.local(world);
        (p.z > 1e-6).then(|| self.pixel(p))
    }

    /// Pixel → ray with z = 1 in camera axes.
    pub fn ray(&self, pixel: [f32; 2]) -> DVec3 {
        ((DVec2::new(pixel[0].into(), pixel[1].into()) - self.c) / self.f).extend(1.0)
    }

    /// Pixel → ray in the world that advances 1 along the optical axis.
    pub fn world_ray(&self, pixel: [f32; 2]) -> DVec3 {
        self.pose.rotation * self.ray(pixel)
    }

    /// World point at a pixel and a depth along the optical axis.
    pub fn unproject(&self, pixel: [f32; 2], depth: f64) -> DVec3 {
        self.pose.center + self.world_ray(pixel) * depth
    }
}

impl From<&View> for Pinhole {
    fn from(view: &View) -> Self {
        Self::new(view.pose, &view.intrinsics, 1.0)
    }
}

/// Pixel and depth → world, in f32.
#[derive(Clone, Copy, Debug)]
pub struct Unprojector {
    m: Mat3,
    center: Vec3,
}

impl Unprojector {
    /// Of a view.
    pub fn new(view: &View) -> Self {
        let k = &view.intrinsics;
        let r = Mat3::from_quat(view.pose.rotation.normalize().as_quat());
        let inverse = Mat3::from_cols(
            Vec3::new(1.0 / k.fx, 0.0, 0.0),
            Vec3::new(0.0, 1.0 / k.fy, 0.0),
            Vec3::new(-k.cx / k.fx, -k.cy / k.fy, 1.0),
        );
        Self { m: r * inverse, center: view.pose.center.as_vec3() }
    }

    /// World point at a pixel and a depth along the optical axis.
    pub fn at(&self, x: f32, y: f32, depth: f32) -> Vec3 {
        self.center + self.m * Vec3::new(x, y, 1.0) * depth
    }
}

/// World → pixel and depth, in f32.
#[derive(Clone, Copy, Debug)]
pub struct Projector {
    m: Mat3,
    t: Vec3,
    k: Intrinsics,
}

impl Projector {
    /// Of a view.
    pub fn new(view: &View) -> Self {
        let (r, t): (Quat, Vec3) = view.pose.world_to_camera();
        Self { m: Mat3::from_quat(r), t, k: view.intrinsics }
    }

    /// Pixel and depth of a world point in front of the camera.
    pub fn project(&self, p: Vec3) -> Option<(f32, f32, f32)> {
        let c = self.m * p + self.t;
        (c.z > 1e-6).then(|| (c.x / c.z * self.k.fx + self.k.cx, c.y / c.z * self.k.fy + self.k.cy, c.z))
    }
}
