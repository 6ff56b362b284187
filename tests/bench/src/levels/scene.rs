//! Draws a scene that lies in a file, leaf by leaf, however large it is: a picture is divided until what a part of it sees is few enough
//! to be drawn whole.

use std::io;
use std::path::Path;

use engine::device::renderer_of_parts;
use glam::DVec3;
use models::camera::{Intrinsics, View};
use models::cloud::GaussianCloud;
use models::levels::Rows;
use vulkan::trainer::{Rendering, Trainer};

use crate::frustum::{Frustum, mean, reach};
use runtime::error::JobError;

/// Gaussians that are drawn at once.
const AT_ONCE: usize = 500_000;
/// Least side of a part, pixels.
const LEAST_SIDE: u32 = 16;

/// Around a leaf, what its Gaussians reach included.
struct BoundingSphere {
    middle: DVec3,
    radius: f64,
}

/// A scene, or a level of one.
pub struct Scene {
    rows: Rows,
    bounds: Vec<BoundingSphere>,
}

impl Scene {
    /// An empty one, in a file without a name in `folder`.
    ///
    /// # Errors
    /// The operating system's.
    pub fn create(folder: &Path, sh_degree: u8) -> io::Result<Self> {
        Ok(Self { rows: Rows::create(folder, sh_degree)?, bounds: Vec::new() })
    }

    /// Appends a leaf.
    ///
    /// # Errors
    /// The operating system's.
    pub fn push(&mut self, leaf: &GaussianCloud) -> io::Result<()> {
        let (low, high) = (0..leaf.len())
            .map(|i| mean(leaf, i))
            .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
        let beyond = (0..leaf.len()).map(|i| reach(leaf, i)).fold(0.0, f64::max);
        let radius = if leaf.is_empty() { f64::NEG_INFINITY } else { 0.5 * low.distance(high) + beyond };
        self.bounds.push(BoundingSphere { middle: 0.5 * (low + high), radius });
        self.rows.push(leaf)
    }

    /// What a camera's part sees; `None` when it is more than can be drawn at once.
    fn seen(&mut self, frustum: &Frustum, sh_degree: u8) -> io::Result<Option<GaussianCloud>> {
        let mut seen = GaussianCloud::with_capacity(sh_degree, 0);
        for leaf in 0..self.bounds.len() {
            if !frustum.meets(self.bounds[leaf].middle, self.bounds[leaf].radius) {
                continue;
            }
            let cloud = self.rows.read(leaf)?;
            let inside: Vec<u32> = (0..cloud.len())
                .filter(|i| frustum.meets(mean(&cloud, *i), reach(&cloud, *i)))
                .map(|i| i as u32)
                .collect();
            if seen.len() + inside.len() > AT_ONCE {
                return Ok(None);
            }
            seen.extend(&cloud.rows(&inside));
        }
        Ok(Some(seen))
    }
}

/// A part of a picture: its first pixel and its size.
#[derive(Clone, Copy)]
struct Part {
    at: [u32; 2],
    size: [u32; 2],
}

impl Part {
    /// The camera whose whole picture it is.
    fn view(&self, whole: &View) -> View {
        let k = &whole.intrinsics;
        let ([x, y], [width, height]) = (self.at, self.size);
        let intrinsics = Intrinsics { width, height, fx: k.fx, fy: k.fy, cx: k.cx - x as f32, cy: k.cy - y as f32 };
        View { intrinsics, pose: whole.pose }
    }

    /// Both halves; `None` when it is too small.
    fn halves(&self) -> Option<[Self; 2]> {
        let k = usize::from(self.size[1] > self.size[0]);
        let first = self.size[k] / 2;
        let (mut a, mut b) = (*self, *self);
        a.size[k] = first;
        (b.at[k], b.size[k]) = (self.at[k] + first, self.size[k] - first);
        (first >= LEAST_SIDE).then_some([a, b])
    }
}

/// Draws scenes.
pub struct Painter {
    trainer: Trainer,
    sh_degree: u8,
    part: Rendering,
}

impl Painter {
    /// For scenes of this SH degree; pictures of `size` are drawn in one go.
    ///
    /// # Errors
    /// No device, or not enough of its memory.
    pub fn open(device: Option<&str>, sh_degree: u8, size: [u32; 2]) -> Result<Self, JobError> {
        let trainer = renderer_of_parts(device, sh_degree, AT_ONCE, size.into())?;
        Ok(Self { trainer, sh_degree, part: Rendering::default() })
    }

    /// Name of the device.
    pub fn device(&self) -> String {
        self.trainer.device().gpu().info().name.clone()
    }

    /// Colours and transmittance of a picture; no depths.
    ///
    /// # Errors
    /// The scene's file; the device; more Gaussians in a few pixels than can be drawn at once.
    pub fn draw(&mut self, scene: &mut Scene, view: &View) -> Result<Rendering, JobError> {
        let (width, height) = (view.intrinsics.width, view.intrinsics.height);
        let pixels = width as usize * height as usize;
        let (rgb, transmittance) = (vec![0.0; 3 * pixels], vec![1.0; pixels]);
        let mut whole = Rendering { width, height, rgb, transmittance, ..Rendering::default() };
        let mut parts = vec![Part { at: [0, 0], size: [width, height] }];
        while let Some(part) = parts.pop() {
            let seen_from = part.view(view);
            let seen = scene.seen(&Frustum::of(&seen_from), self.sh_degree);
            let Some(cloud) = seen.map_err(|e| JobError::Request(format!("a scratch file of the scene: {e}")))? else {
                let crowded = || JobError::Request(format!("more than {AT_ONCE} Gaussians in a few pixels"));
                parts.extend(part.halves().ok_or_else(crowded)?);
                continue;
            };
            if !cloud.is_empty() {
                self.trainer.load(&cloud)?;
                self.trainer.render(&seen_from, &mut self.part)?;
                copy(&self.part, part, &mut whole);
            }
        }
        Ok(whole)
    }
}

fn copy(from: &Rendering, part: Part, into: &mut Rendering) {
    let ([x, y], [width, height]) = (part.at.map(|n| n as usize), part.size.map(|n| n as usize));
    for row in 0..height {
        let at = (y + row) * into.width as usize + x;
        into.rgb[3 * at..3 * (at + width)].copy_from_slice(&from.rgb[3 * row * width..3 * (row + 1) * width]);
        into.transmittance[at..at + width].copy_from_slice(&from.transmittance[row * width..(row + 1) * width]);
    }
}

#[cfg(test)]
mod tests {
    use models::camera::Pose;

    use super::*;

    fn looking_down(from: DVec3) -> View {
        let intrinsics = Intrinsics { width: 96, height: 64, fx: 80.0, fy: 80.0, cx: 48.0, cy: 32.0 };
        View { intrinsics, pose: Pose { rotation: glam::DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: from } }
    }

    #[test]
    fn a_frustum_meets_what_a_picture_may_show_and_nothing_far_beside_it() {
        let frustum = Frustum::of(&looking_down(DVec3::new(5.0, 0.0, 10.0)));
        assert!(frustum.meets(DVec3::new(5.0, 0.0, 0.0), 0.1));
        // 48 pixels are 6 m at 10 m.
        assert!(frustum.meets(DVec3::new(11.2, 0.0, 0.0), 0.1) && !frustum.meets(DVec3::new(12.5, 0.0, 0.0), 0.1));
        assert!(frustum.meets(DVec3::new(14.0, 0.0, 0.0), 4.0));
        assert!(!frustum.meets(DVec3::new(5.0, 0.0, 11.0), 0.5), "behind the camera");
    }

    #[test]
    fn a_picture_drawn_in_parts_is_the_picture_drawn_whole() {
        let mut cloud = GaussianCloud::with_capacity(0, 4_000);
        for i in 0..4_000 {
            let (x, y) = ((i % 80) as f32 * 0.2 - 8.0, (i / 80) as f32 * 0.2 - 5.0);
            let colour = [(i % 7) as f32 * 0.3 - 1.0, (i % 5) as f32 * 0.4 - 1.0, 0.2];
            cloud.push([x, y, 0.3 * x.sin()], [-1.9, -1.6, -3.0], [1.0, 0.1, 0.0, 0.2], 2.0, &colour);
        }
        let Ok(mut painter) = Painter::open(None, 0, [96, 64]) else {
            return needs::missing(needs::Need::Vulkan, "no Vulkan device");
        };
        let folder = tempfile::tempdir().expect("a folder");
        let mut scene = Scene::create(folder.path(), 0).expect("a file");
        for leaf in 0..8 {
            scene.push(&cloud.rows(&(500 * leaf..500 * (leaf + 1)).collect::<Vec<u32>>())).expect("written");
        }
        scene.push(&GaussianCloud::with_capacity(0, 0)).expect("an empty leaf");
        let view = looking_down(DVec3::new(0.0, 0.0, 9.0));
        let whole = painter.draw(&mut scene, &view).expect("drawn");
        assert!(whole.transmittance.iter().any(|t| *t < 0.1));
        let mut worst = 0.0f32;
        let halves = Part { at: [0, 0], size: [96, 64] }.halves().expect("large enough");
        for part in halves.iter().flat_map(|half| half.halves().expect("large enough")) {
            let drawn = painter.draw(&mut scene, &part.view(&view)).expect("drawn");
            for (i, t) in drawn.transmittance.iter().enumerate() {
                let (x, y) = (i % part.size[0] as usize, i / part.size[0] as usize);
                let at = (part.at[1] as usize + y) * 96 + part.at[0] as usize + x;
                worst = worst.max((t - whole.transmittance[at]).abs());
                worst = (0..3).map(|k| (drawn.rgb[3 * i + k] - whole.rgb[3 * at + k]).abs()).fold(worst, f32::max);
            }
        }
        assert!(worst < 2.0 / 255.0, "{worst}");
    }
}
