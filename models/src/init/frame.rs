//! One key frame while it waits for, and after it got, its depth. Everything is kept at the network's size, u8 and
//! strided, so that memory is known from the number of pictures alone.

use glam::{DVec3, Vec3};
use image::RgbImage;

use crate::camera::View;

/// Depth of one picture on a grid of every `stride`-th pixel.
#[derive(Clone, Debug)]
pub struct DepthGrid {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels between samples.
    pub stride: usize,
    /// Along the optical axis, metres.
    pub depth: Vec<f32>,
    /// 0…1; 0 = no depth.
    pub confidence: Vec<f32>,
}

impl DepthGrid {
    /// Takes every `stride`-th pixel of full maps (centre of each block). Depths that are not positive and finite get
    /// confidence 0; returns how many had claimed more.
    pub fn sampled(width: usize, height: usize, stride: usize, depth: &[f32], confidence: &[f32]) -> (Self, usize) {
        let (w, h) = ((width / stride).max(1), (height / stride).max(1));
        let mut grid = Self {
            width: w,
            height: h,
            stride,
            depth: Vec::with_capacity(w * h),
            confidence: Vec::with_capacity(w * h),
        };
        let mut unsound = 0;
        for j in 0..h {
            for i in 0..w {
                let at = (j * stride + stride / 2).min(height - 1) * width + (i * stride + stride / 2).min(width - 1);
                let (d, c) = (depth[at], confidence[at]);
                let sound = d.is_finite() && d > 0.0 && c.is_finite();
                unsound += usize::from(!sound && c != 0.0);
                grid.depth.push(if sound { d } else { 0.0 });
                grid.confidence.push(if sound { c.clamp(0.0, 1.0) } else { 0.0 });
            }
        }
        (grid, unsound)
    }

    /// Pixel position (of the network's picture) of a sample.
    pub fn pixel(&self, i: usize, j: usize) -> (f32, f32) {
        let half = (self.stride / 2) as f32 + 0.5;
        ((i * self.stride) as f32 + half, (j * self.stride) as f32 + half)
    }

    /// The sample whose block holds a pixel position.
    pub fn index_at(&self, x: f32, y: f32) -> Option<usize> {
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (i, j) = (x as usize / self.stride, y as usize / self.stride);
        (i < self.width && j < self.height).then(|| j * self.width + i)
    }
}

/// One key frame.
#[derive(Debug)]
pub struct Frame {
    /// Name of the picture.
    pub name: String,
    /// The picture at the network's size.
    pub image: RgbImage,
    /// Its camera, intrinsics at the network's size.
    pub view: View,
    /// Its depth, once known.
    pub depth: Option<DepthGrid>,
    /// The source views that the depth was made from, as they were then.
    pub made_with: Vec<(usize, View)>,
    /// The reference view that the depth was made from.
    pub made_as: Option<View>,
}

/// Point at a pixel and a depth along the optical axis, in the world.
pub fn unproject(view: &View, x: f32, y: f32, depth: f32) -> Vec3 {
    let k = &view.intrinsics;
    let ray = DVec3::new(f64::from((x - k.cx) / k.fx), f64::from((y - k.cy) / k.fy), 1.0) * f64::from(depth);
    (view.pose.rotation * ray + view.pose.center).as_vec3()
}

/// Pixel and depth → world, as plain f32 numbers for inner loops.
#[derive(Clone, Copy, Debug)]
pub struct Unprojector {
    m: glam::Mat3,
    center: Vec3,
}

impl Unprojector {
    /// Of a view.
    pub fn new(view: &View) -> Self {
        let k = &view.intrinsics;
        let r = glam::Mat3::from_quat(view.pose.rotation.normalize().as_quat());
        let inverse = glam::Mat3::from_cols(
            Vec3::new(1.0 / k.fx, 0.0, 0.0),
            Vec3::new(0.0, 1.0 / k.fy, 0.0),
            Vec3::new(-k.cx / k.fx, -k.cy / k.fy, 1.0),
        );
        Self { m: r * inverse, center: view.pose.center.as_vec3() }
    }

    /// Point at a pixel and a depth along the optical axis.
    pub fn at(&self, x: f32, y: f32, depth: f32) -> Vec3 {
        self.center + self.m * Vec3::new(x, y, 1.0) * depth
    }
}

/// World → camera, as plain f32 numbers for inner loops.
#[derive(Clone, Copy, Debug)]
pub struct Projector {
    m: glam::Mat3,
    t: Vec3,
    k: crate::camera::Intrinsics,
}

impl Projector {
    /// Of a view.
    pub fn new(view: &View) -> Self {
        let (r, t) = view.pose.world_to_camera();
        Self { m: glam::Mat3::from_quat(r), t, k: view.intrinsics }
    }

    /// Pixel and depth of a world point in front of the camera.
    pub fn project(&self, p: Vec3) -> Option<(f32, f32, f32)> {
        let c = self.m * p + self.t;
        (c.z > 1e-6).then(|| (c.x / c.z * self.k.fx + self.k.cx, c.y / c.z * self.k.fy + self.k.cy, c.z))
    }
}

/// Largest shift, in pixels, of the reference's corners and centre in the source between two pairs of poses.
pub fn shift(reference: &View, source: &View, old_reference: &View, old_source: &View, depth: f32) -> f32 {
    let (w, h) = (reference.intrinsics.width as f32, reference.intrinsics.height as f32);
    let (new, old) = (Projector::new(source), Projector::new(old_source));
    [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h), (w / 2.0, h / 2.0)]
        .into_iter()
        .map(|(x, y)| {
            let a = new.project(unproject(reference, x, y, depth));
            let b = old.project(unproject(old_reference, x, y, depth));
            match (a, b) {
                (Some(a), Some(b)) => (a.0 - b.0).hypot(a.1 - b.1),
                _ => f32::INFINITY,
            }
        })
        .fold(0.0, f32::max)
}
