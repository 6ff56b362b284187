//! A depth grid becomes pixel-aligned samples: position, colour, and a covariance from the distance to the
//! neighbours and the local normal (sˡ), scaled to the poses (sᵍ).

use glam::{Mat3, Vec3};
use image::RgbImage;
use rayon::prelude::*;

use config::init::InitSettings;

use super::depth_frame::DepthGrid;
use super::merge::Sample;
use super::unposed::Appearance;
use crate::camera::{Unprojector, View};

/// Standard deviation of a sample as a share of the distance to its neighbours: discs of 0.5 spacings on a grid
/// add up to an even surface (ripple below 2 %).
const EXTENT: f32 = 0.5;
/// Thickness along the normal, as a share of the extent.
const FLATNESS: f32 = 0.2;
/// Opacity falls with this power of the confidence: slowly, because a hole costs more than a wrong colour.
const FADING: f32 = 0.1;
/// Neighbours further away than this many pixel footprints lie on another surface.
const JUMP: f32 = 4.0;
/// Half the distance, in samples, over which slopes are measured: wide enough not to follow the depth's noise.
const REACH: usize = 2;

/// What a network that knows no scale would give: the extent of one sample at depth 1.
fn unit_extent(view: &View, stride: usize) -> f32 {
    EXTENT * stride as f32 / view.intrinsics.fx.max(view.intrinsics.fy)
}

/// Samples of one picture, row by row; `image` is the frame's.
///
/// `appearance` is what an unposed network says about the Gaussians; without it extent and colour come from the grid and the
/// picture.
pub fn samples(
    view: &View,
    image: &RgbImage,
    grid: &DepthGrid,
    appearance: Option<&Appearance>,
    settings: &InitSettings,
    global_scale: f32,
) -> Vec<Vec<Sample>> {
    let unproject = Unprojector::new(view);
    let points: Vec<Vec3> = (0..grid.depth.len())
        .into_par_iter()
        .map(|at| {
            let (x, y) = grid.pixel(at % grid.width, at / grid.width);
            unproject.at(x, y, grid.depth[at])
        })
        .collect();
    let scene = Scene {
        view,
        image,
        grid,
        points,
        appearance,
        axes: Mat3::from_quat(view.pose.rotation.normalize().as_quat()),
    };
    let row = |j| {
        let mut row = Vec::with_capacity(grid.width);
        row.extend((0..grid.width).filter_map(|i| scene.sample((i, j), settings, global_scale)));
        row
    };
    (0..grid.height).into_par_iter().map(row).collect()
}

/// A depth grid with its points in the world.
struct Scene<'a> {
    view: &'a View,
    image: &'a RgbImage,
    grid: &'a DepthGrid,
    points: Vec<Vec3>,
    appearance: Option<&'a Appearance>,
    /// Camera axes in the world.
    axes: Mat3,
}

impl Scene<'_> {
    fn sample(&self, (i, j): (usize, usize), settings: &InitSettings, global: f32) -> Option<Sample> {
        let grid = self.grid;
        let at = j * grid.width + i;
        let confidence = grid.confidence[at];
        if confidence.is_nan() || confidence < settings.min_confidence.max(1e-4) {
            return None;
        }
        let (x, y) = grid.pixel(i, j);
        let picture = mean_color(self.image, x, y, grid.stride);
        if let Some(a) = self.appearance {
            let color = if a.residual { picture + a.colors[at] } else { a.colors[at] };
            return Some(Sample {
                position: self.points[at],
                color: color.clamp(Vec3::ZERO, Vec3::ONE),
                covariance: a.covariances[at],
                weight: confidence,
                opacity: a.opacities[at].clamp(0.0, 1.0),
            });
        }
        let covariance = if settings.local_scale {
            self.covariance((i, j))
        } else {
            let extent = unit_extent(self.view, grid.stride) * if settings.global_scale { global } else { 1.0 };
            Mat3::IDENTITY * (extent * extent)
        };
        Some(Sample {
            position: self.points[at],
            color: picture,
            covariance,
            weight: confidence,
            opacity: settings.opacity * confidence.powf(FADING),
        })
    }

    /// Spread over half the way to the neighbours in both directions of the grid, and a little along the normal.
    fn covariance(&self, (i, j): (usize, usize)) -> Mat3 {
        let (grid, k) = (self.grid, &self.view.intrinsics);
        let footprint = grid.depth[j * grid.width + i] * grid.stride as f32;
        let footprint = [footprint / k.fx, footprint / k.fy];
        let mut tangents = [self.axes.x_axis * footprint[0], self.axes.y_axis * footprint[1]];
        for (axis, tangent) in tangents.iter_mut().enumerate() {
            let (size, own, step) = if axis == 0 { (grid.width, i, 1) } else { (grid.height, j, grid.width) };
            let base = j * grid.width + i - own * step;
            let (lo, hi) = (own.saturating_sub(REACH), (own + REACH).min(size - 1));
            let (a, b) = (base + lo * step, base + hi * step);
            if hi > lo && grid.confidence[a] > 0.0 && grid.confidence[b] > 0.0 {
                let slope = (self.points[b] - self.points[a]) / (hi - lo) as f32;
                if slope.length() < JUMP * footprint[axis] {
                    *tangent = slope;
                }
            }
        }
        let normal = tangents[0].cross(tangents[1]).normalize_or(self.axes.z_axis);
        let thickness = FLATNESS * tangents[0].length().min(tangents[1].length());
        (outer(tangents[0]) + outer(tangents[1]) + outer(normal * thickness)) * (EXTENT * EXTENT)
    }
}

fn outer(v: Vec3) -> Mat3 {
    Mat3::from_cols(v * v.x, v * v.y, v * v.z)
}

/// Mean colour of a sample's block.
fn mean_color(image: &RgbImage, x: f32, y: f32, stride: usize) -> Vec3 {
    let half = (stride / 2) as f32;
    let (x0, y0) = ((x - half).max(0.0) as u32, (y - half).max(0.0) as u32);
    let mut sum = Vec3::ZERO;
    let mut n = 0.0;
    for v in y0..(y0 + stride as u32).min(image.height()) {
        for u in x0..(x0 + stride as u32).min(image.width()) {
            let p = image.get_pixel(u, v).0;
            sum += Vec3::new(f32::from(p[0]), f32::from(p[1]), f32::from(p[2]));
            n += 255.0;
        }
    }
    if n > 0.0 { sum / n } else { Vec3::splat(0.5) }
}
