//! A procedural world of ground, houses, cars and trees, ray-cast on the CPU with exact depth.
//!
//! It stands in for the camera's subject wherever no aircraft flies: in the demo, in tests, and behind recorded
//! telemetry. It shares nothing with the Gaussian renderer, so a picture that both agree on means something.
//! Everything is a function of the seed; pictures are identical whatever the number of threads.

mod layout;
mod noise;
mod solids;
mod surface;
mod terrain;

use glam::{DMat3, DQuat, DVec3};
use image::{Rgb, RgbImage};
use rayon::prelude::*;

use solids::{Material, Solids};
use terrain::Terrain;

/// Direction to the sun (not of unit length): fixed, so that shadows are part of the scene.
const SUN: DVec3 = DVec3::new(0.42, -0.30, 0.86);
/// Share of light in shadow.
const AMBIENT: f32 = 0.46;
/// Above all that stands in any world, metres.
const SUMMIT: f64 = 1000.0;
/// Colour of the sky, and depth 0.
const SKY: [f32; 3] = [0.62, 0.74, 0.88];

/// Size and contents of a world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WorldSettings {
    /// Half the side of the square with relief and things on it, metres (20 to 2000); a textured plane beyond.
    pub half_extent_m: f64,
    /// Height difference of the rolling ground, metres; 0 makes it the plane z = 0.
    pub relief_m: f32,
    /// Number of houses, trees and cars relative to the usual; 0 leaves bare ground.
    pub density: f32,
}

impl Default for WorldSettings {
    fn default() -> Self {
        Self { half_extent_m: 240.0, relief_m: 5.0, density: 1.0 }
    }
}

/// A pinhole camera somewhere in the world. Lengths in pixels; the centre of the top-left pixel is (0.5, 0.5).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PinholeView {
    /// Picture width.
    pub width: u32,
    /// Picture height.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
    /// Camera centre, ENU metres.
    pub position: DVec3,
    /// Camera (OpenCV axes: x right, y down, z forward) → ENU.
    pub rotation: DQuat,
}

/// The world of a seed.
pub struct World {
    seed: u32,
    terrain: Terrain,
    solids: Solids,
}

/// What a map shows at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FromAbove {
    /// Red, green, blue, 0 to 1.
    pub color: [f32; 3],
    /// Metres above z = 0.
    pub height: f64,
    /// What it is.
    pub kind: MapKind,
}

/// What a map shows at a place, by what can be said of its height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MapKind {
    /// The bare ground.
    Ground,
    /// A house.
    Roof,
    /// A car.
    Car,
    /// Leaves and straw, which have no one height.
    Plant,
}

/// What kind of thing a ray met.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Surface {
    Sky,
    Ground,
    Solid(u32),
}

/// What a ray met.
#[derive(Clone, Copy, Debug)]
struct Hit {
    /// Depth along the optical axis, metres; 0 for the sky.
    t: f64,
    normal: DVec3,
    surface: Surface,
    /// The sun shines on it.
    lit: bool,
}

impl Hit {
    const SKY: Self = Self { t: 0.0, normal: DVec3::Z, surface: Surface::Sky, lit: true };

    /// Where a ray close to the one that made this hit meets its tangent plane.
    fn beside(&self, made_by: DVec3, direction: DVec3) -> Self {
        let speed = self.normal.dot(direction);
        let ratio = if speed.abs() > 1e-9 { (self.normal.dot(made_by) / speed).clamp(0.8, 1.25) } else { 1.0 };
        Self { t: self.t * ratio, ..*self }
    }
}

impl World {
    /// Builds the world; settings out of range are clamped into it. A few milliseconds.
    pub fn new(seed: u64, settings: &WorldSettings) -> Self {
        let seed = (seed ^ (seed >> 32)) as u32;
        let half = if settings.half_extent_m.is_finite() { settings.half_extent_m.clamp(20.0, 2000.0) } else { 240.0 };
        let terrain = Terrain::new(seed, half, settings.relief_m.clamp(0.0, 60.0));
        let solids = Solids::new(layout::populate(&terrain, seed, settings.density.clamp(0.0, 3.0)), &terrain);
        Self { seed, terrain, solids }
    }

    /// Height of the bare ground, metres above z = 0.
    pub fn ground_height(&self, x: f64, y: f64) -> f64 {
        self.terrain.height(x, y)
    }

    /// Number of houses, cars and trees.
    pub fn solid_count(&self) -> usize {
        self.solids.len()
    }

    /// The picture (2 × 2 samples per pixel) and, for every pixel centre, the depth along the optical axis in
    /// metres, row by row; 0 where the ray leaves the world. Uses rayon's current thread pool.
    pub fn render(&self, view: &PinholeView) -> (RgbImage, Vec<f32>) {
        let (w, h) = (view.width as usize, view.height as usize);
        let rotation = DMat3::from_quat(view.rotation.normalize());
        let ray = |x: f64, y: f64| rotation * DVec3::new((x - view.cx) / view.fx, (y - view.cy) / view.fy, 1.0);
        // First what every pixel centre sees; the samples around it then follow from that surface's tangent plane,
        // except along edges, where each is cast on its own.
        let mut centres = vec![Hit::SKY; w * h];
        centres.par_chunks_mut(w.max(1)).enumerate().for_each(|(row, line)| {
            for (column, hit) in line.iter_mut().enumerate() {
                *hit = self.cast(view.position, ray(column as f64 + 0.5, row as f64 + 0.5));
            }
        });
        let sample = (0.5 / view.fx.abs().min(view.fy.abs())) as f32;
        let mut pixels = vec![0u8; w * h * 3];
        pixels.par_chunks_mut((w * 3).max(1)).enumerate().for_each(|(row, line)| {
            for (column, out) in line.chunks_exact_mut(3).enumerate() {
                let centre = &centres[row * w + column];
                let smooth = is_smooth(&centres, w, row, column);
                let (x, y) = (column as f64 + 0.5, row as f64 + 0.5);
                let mut sum = [0.0f32; 3];
                for (dx, dy) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                    let direction = ray(x + dx, y + dy);
                    let c = if smooth {
                        self.shade(&centre.beside(ray(x, y), direction), view.position, direction, sample)
                    } else {
                        self.shade(&self.cast(view.position, direction), view.position, direction, sample)
                    };
                    for k in 0..3 {
                        sum[k] += c[k].clamp(0.0, 1.0);
                    }
                }
                for (o, s) in out.iter_mut().zip(sum) {
                    *o = (s * 63.75 + 0.5) as u8;
                }
            }
        });
        let picture = RgbImage::from_raw(view.width, view.height, pixels)
            .unwrap_or_else(|| RgbImage::from_pixel(view.width, view.height, Rgb([0, 0, 0])));
        (picture, centres.iter().map(|hit| hit.t as f32).collect())
    }

    /// What a map shows at a place, from straight above; its texture is what a square of `footprint_m` shows of it.
    pub fn from_above(&self, x: f64, y: f64, footprint_m: f64) -> FromAbove {
        let (origin, direction) = (DVec3::new(x, y, SUMMIT), -DVec3::Z);
        let hit = self.cast(origin, direction);
        let color = self.shade(&hit, origin, direction, (footprint_m / hit.t) as f32);
        let kind = match hit.surface {
            Surface::Solid(index) => match self.solids.get(index).material {
                Material::House => MapKind::Roof,
                Material::Car => MapKind::Car,
                Material::Leaves | Material::Straw => MapKind::Plant,
            },
            Surface::Ground | Surface::Sky => MapKind::Ground,
        };
        FromAbove { color, height: SUMMIT - hit.t, kind }
    }

    /// Depth along the optical axis at one pixel position, metres; None for the sky.
    pub fn depth_at(&self, view: &PinholeView, x: f64, y: f64) -> Option<f64> {
        let direction = view.rotation.normalize() * DVec3::new((x - view.cx) / view.fx, (y - view.cy) / view.fy, 1.0);
        let hit = self.cast(view.position, direction);
        (hit.surface != Surface::Sky).then_some(hit.t)
    }

    /// First surface along a ray; `direction` has length 1 along the optical axis, so t is the depth.
    fn cast(&self, origin: DVec3, direction: DVec3) -> Hit {
        let ground = self.terrain.hit(origin, direction, 0.0);
        let mut hit = match self.solids.hit(origin, direction, 0.0, ground.unwrap_or(1e5), false) {
            Some(hit) => Hit { t: hit.t, normal: hit.normal, surface: Surface::Solid(hit.index), lit: false },
            None => match ground {
                Some(t) => {
                    let p = origin + t * direction;
                    Hit { t, normal: self.terrain.normal(p.x, p.y), surface: Surface::Ground, lit: false }
                }
                None => return Hit::SKY,
            },
        };
        let start = origin + hit.t * direction + hit.normal * 0.02;
        hit.lit = hit.normal.dot(SUN) > 0.0 && self.solids.hit(start, SUN, 0.0, 200.0, true).is_none();
        hit
    }

    /// Light leaving the surface towards the camera; `sample` is the angle between samples, radians.
    fn shade(&self, hit: &Hit, origin: DVec3, direction: DVec3, sample: f32) -> [f32; 3] {
        let p = origin + hit.t * direction;
        // The footprint grows on surfaces seen at a slant; bounded so that edges of solids keep their texture.
        let slant = (hit.normal.dot(direction).abs() / direction.length()).max(0.2) as f32;
        let footprint = hit.t as f32 * sample / slant;
        let albedo = match hit.surface {
            Surface::Sky => return SKY,
            Surface::Ground => surface::ground(p.x, p.y, footprint, self.seed),
            Surface::Solid(index) => surface::solid(self.solids.get(index), p, hit.normal, footprint),
        };
        let sun = if hit.lit { 0.74 * (hit.normal.dot(SUN) / SUN.length()) as f32 } else { 0.0 };
        let light = AMBIENT * (0.75 + 0.25 * hit.normal.z as f32) + sun;
        albedo.map(|a| a * light)
    }
}

/// True when a pixel and its eight neighbours see one surface, in one light: no edge passes through.
fn is_smooth(centres: &[Hit], w: usize, row: usize, column: usize) -> bool {
    let h = centres.len() / w;
    if row == 0 || column == 0 || row + 1 >= h || column + 1 >= w {
        return false;
    }
    let c = &centres[row * w + column];
    (row - 1..=row + 1).all(|r| {
        centres[r * w + column - 1..=r * w + column + 1]
            .iter()
            .all(|n| n.surface == c.surface && n.lit == c.lit && n.normal.dot(c.normal) > 0.9)
    })
}

#[cfg(test)]
mod tests;
