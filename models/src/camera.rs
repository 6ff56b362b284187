//! Pinhole cameras and posed pictures, in OpenCV axes and COLMAP's pixel convention.

use glam::{DQuat, DVec2, DVec3, Mat4, Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::mask::Mask;

mod projection;

pub use projection::{Pinhole, Projector, Unprojector};

/// Longest edge of a picture taken, pixels.
pub const MAX_EDGE: u32 = 16_384;
/// Most pixels of a picture taken: the largest sensors that fly have 61 million.
pub const MAX_PIXELS: usize = 1 << 26;

/// A pinhole camera without distortion (pictures are undistorted on ingest). Lengths in pixels; the centre of
/// the top-left pixel is (0.5, 0.5).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Focal length along x.
    pub fx: f32,
    /// Focal length along y.
    pub fy: f32,
    /// Principal point, x.
    pub cx: f32,
    /// Principal point, y.
    pub cy: f32,
}

impl Intrinsics {
    /// The camera of the same picture resampled to `width` × `height`.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = width as f32 / self.width as f32;
        let sy = height as f32 / self.height as f32;
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }

    /// Whether a pixel position lies in the picture.
    pub fn contains(&self, p: DVec2) -> bool {
        p.x >= 0.0 && p.y >= 0.0 && p.x < f64::from(self.width) && p.y < f64::from(self.height)
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// Where a camera stood: camera (OpenCV axes) → world (ENU), kept in f64 so that refinement does not lose digits.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Rotation camera → world.
    pub rotation: DQuat,
    /// Camera centre in the world, metres.
    pub center: DVec3,
}

impl Pose {
    /// World → camera rotation and translation, f32 (what the renderer takes).
    pub fn world_to_camera(&self) -> (Quat, Vec3) {
        let r = self.rotation.conjugate().normalize();
        (r.as_quat(), (-(r * self.center)).as_vec3())
    }

    /// World → camera as a matrix.
    pub fn viewmat(&self) -> Mat4 {
        let (r, t) = self.world_to_camera();
        Mat4::from_rotation_translation(r, t)
    }

    /// Unit vector along the optical axis, in the world.
    pub fn forward(&self) -> DVec3 {
        self.rotation * DVec3::Z
    }
}

/// A camera at a place: all a renderer needs to know.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// The lens.
    pub intrinsics: Intrinsics,
    /// The place.
    pub pose: Pose,
}

impl View {
    /// Whether a picture of this size exists, the lens and the pose are finite numbers and the rotation has a direction:
    /// what a view from another machine must be before anything is sized or drawn by it.
    pub fn is_usable(&self) -> bool {
        let (k, p) = (&self.intrinsics, &self.pose);
        (1..=MAX_EDGE).contains(&k.width)
            && (1..=MAX_EDGE).contains(&k.height)
            && k.pixels() <= MAX_PIXELS
            && [k.fx, k.fy].iter().all(|f| f.is_finite() && *f > 0.0)
            && [k.cx, k.cy].iter().all(|c| c.is_finite())
            && p.center.is_finite()
            && p.rotation.is_finite()
            && (0.5..2.0).contains(&p.rotation.length())
    }
}

/// A view from infinitely far: parallel rays along the optical axis. What maps are drawn with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrthographicView {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Scale along x and y.
    pub pixels_per_metre: [f64; 2],
    /// `center` is drawn in the picture's middle; depth counts from there, and what lies before it is not drawn.
    pub pose: Pose,
}

/// How far a pose may be wrong, one standard deviation; infinite where nothing is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseSigma {
    /// East, north, up, metres.
    pub position_m: [f32; 3],
    /// Rotation about the camera's x, y, z axes, radians.
    pub rotation_rad: [f32; 3],
}

/// What is known of a pose before the pictures are asked: where it came from is the reader's business.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosePrior {
    /// The pose.
    pub pose: Pose,
    /// What it is worth.
    pub sigma: PoseSigma,
    /// Exposure on the camera's own clock, nanoseconds since 1970 were it UTC; 0 where not recorded.
    pub time_ns: u64,
}

/// One picture with its pose.
#[derive(Clone, Debug)]
pub struct PosedImage {
    /// File name without its folder; unique within a data set.
    pub name: String,
    /// Mid-exposure, nanoseconds on the companion's clock (0 in data sets without times).
    pub time_ns: u64,
    /// Undistorted RGB.
    pub image: image::RgbImage,
    /// Which of its pixels count, at its size; `None`: all.
    pub mask: Option<Mask>,
    /// Lens and place. `intrinsics` matches `image`'s size.
    pub view: View,
    /// How far the pose may be wrong.
    pub sigma: PoseSigma,
}

impl PosedImage {
    /// Whether this pixel counts.
    pub fn keeps(&self, x: u32, y: u32) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.keeps(x, y))
    }
}

/// An estimated depth map that the Pearson loss correlates with the rendered one.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthPrior {
    /// Width of both maps, pixels.
    pub width: u32,
    /// Height of both maps, pixels.
    pub height: u32,
    /// Depth along the optical axis (metres or any positive affine of it), row-major; values where
    /// `confidence` is 0 are ignored and may be anything.
    pub depth: Vec<f32>,
    /// 0..1, row-major; 0 = no opinion.
    pub confidence: Vec<f32>,
}
