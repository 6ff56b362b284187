//! What every reconstruction file says, whoever wrote it: lenses, poses, picture names, and where on the earth it lies.
//! [`super::colmap`], [`super::transforms`] and [`super::opensfm`] read and write it.

use std::path::Path;

use geometry::geodesy::Geodetic;
use geometry::lens::{Distortion, Lens};
use geometry::median;
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::FormatError;
use crate::camera::{Intrinsics, Pose};

/// More pictures than one survey has; bounds what later stages allocate per picture.
pub(crate) const MAX_SHOTS: u64 = 100_000;
/// Longest edge of a picture that a file may speak of, pixels.
const MAX_EDGE: f64 = 65_536.0;

/// A reconstruction: posed pictures, without their pixels.
#[derive(Clone, Debug, Default)]
pub struct Reconstruction {
    /// In the order of the file, or of names where a file has no meaningful order.
    pub shots: Vec<Shot>,
    /// WGS-84 origin of the world frame (local east-north-up), when the file tells it.
    pub origin: Option<Geodetic>,
}

/// One posed picture.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Path of the picture as the file names it, relative to its picture folder.
    pub path: String,
    /// Lens at the size the file speaks of.
    pub lens: LensDescription,
    /// Camera (OpenCV axes) → world.
    pub pose: Pose,
    /// Path of the picture's mask, where the file names one.
    pub mask: Option<String>,
}

/// How the coordinates of a scene that is nowhere on Earth were brought near those that 32 bits hold well and that training's lengths are
/// made for: `own = (theirs - shift) · scale`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalFrame {
    /// Taken off their coordinates.
    pub shift: [f64; 3],
    /// Own units to one of theirs.
    pub scale: f64,
}

/// A scene farther from its origin than this many times its own extent is moved: 32 bits would have it to a ten-thousandth of the extent.
const FAR: f64 = 500.0;
/// Half of the cameras lie within this of their middle in scenes as they come; others are brought to between 1 and 10.
const EXTENTS: std::ops::Range<f64> = 0.3..5000.0;

impl LocalFrame {
    /// For a scene whose cameras stand here; `None` where its coordinates are good as they are.
    pub fn of(places: &[DVec3]) -> Option<Self> {
        let axis = |k: usize| median(&mut places.iter().map(|p| p[k]).collect::<Vec<_>>());
        let middle = DVec3::new(axis(0)?, axis(1)?, axis(2)?);
        let extent = median(&mut places.iter().map(|p| p.distance(middle)).collect::<Vec<_>>())?;
        if !(extent > 0.0 && extent.is_finite()) {
            return None;
        }
        let step = 10f64.powf(extent.log10().floor());
        let scale = if EXTENTS.contains(&extent) { 1.0 } else { 1.0 / step };
        // Whole numbers of a round length, so that nobody reads meaning into digits.
        let moved = middle.length() > FAR * extent;
        let shift = if moved { middle.map(|v| (v / step).round() * step + 0.0) } else { DVec3::ZERO };
        (moved || scale != 1.0).then(|| Self { shift: shift.to_array(), scale })
    }

    /// Their coordinates in ours.
    pub fn into_own(&self, theirs: DVec3) -> DVec3 {
        (theirs - DVec3::from_array(self.shift)) * self.scale
    }

    /// Ours in theirs.
    pub fn into_theirs(&self, own: DVec3) -> DVec3 {
        own / self.scale + DVec3::from_array(self.shift)
    }

    /// Whether numbers and factor are those of a scene.
    pub fn is_usable(&self) -> bool {
        self.shift.iter().all(|v| v.is_finite()) && self.scale.is_finite() && self.scale > 0.0
    }
}

impl std::fmt::Display for LocalFrame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [x, y, z] = self.shift;
        write!(f, "({x}, {y}, {z}) taken off")?;
        if self.scale == 1.0 { Ok(()) } else { write!(f, ", times {}", self.scale) }
    }
}

/// A lens as a file describes it; picture size and principal point may have to be taken from the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LensDescription {
    /// Width and height, pixels, where the file has them.
    pub size: Option<(u32, u32)>,
    /// Focal lengths.
    pub focal: Focal,
    /// Principal point, pixels, the centre of the first pixel being (0.5, 0.5); `None` = the middle.
    pub principal: Option<(f64, f64)>,
    /// All zero for a pinhole.
    pub distortion: Distortion,
}

/// How a file states the focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Focal {
    /// fx, fy, pixels.
    Pixels(f64, f64),
    /// Horizontal field of view, radians (`camera_angle_x` of Blender data sets).
    FieldOfView(f64),
}

impl LensDescription {
    /// A lens in pixels of a picture of known size.
    pub fn new(intrinsics: &Intrinsics, distortion: Distortion) -> Self {
        Self {
            size: Some((intrinsics.width, intrinsics.height)),
            focal: Focal::Pixels(intrinsics.fx.into(), intrinsics.fy.into()),
            principal: Some((intrinsics.cx.into(), intrinsics.cy.into())),
            distortion,
        }
    }

    /// The pinhole of the undistorted picture of `width` × `height` pixels.
    pub fn intrinsics(&self, (width, height): (u32, u32)) -> Intrinsics {
        let lens = self.lens((width, height));
        let [fx, fy, cx, cy] = [lens.focal[0], lens.focal[1], lens.principal[0], lens.principal[1]].map(|v| v as f32);
        Intrinsics { width, height, fx, fy, cx, cy }
    }

    /// Everything in pixels of a picture of `width` × `height` pixels.
    pub fn lens(&self, (width, height): (u32, u32)) -> Lens {
        let (w, h) = (f64::from(width), f64::from(height));
        let focal = match self.focal {
            Focal::Pixels(x, y) => [x, y],
            Focal::FieldOfView(angle) => [0.5 * w / (0.5 * angle).tan(); 2],
        };
        let (cx, cy) = self.principal.unwrap_or((0.5 * w, 0.5 * h));
        Lens { focal, principal: [cx, cy], distortion: self.distortion }
    }

    /// What is impossible about it, in a few words.
    pub fn fault(&self) -> Option<&'static str> {
        let d = &self.distortion;
        let terms = [d.k1, d.k2, d.k3, d.k4, d.p1, d.p2, d.q1, d.q2, d.q3, d.sx1, d.sy1];
        // What is computed with them is an f32.
        let could_be = |focal: f64| focal > 0.0 && (focal as f32).is_normal();
        match self.focal {
            Focal::Pixels(x, y) if !(could_be(x) && could_be(y)) => Some("its focal lengths must be positive numbers"),
            Focal::FieldOfView(a) if !(a > 0.0 && a < std::f64::consts::PI) => {
                Some("its field of view must lie between 0 and pi")
            }
            // Of the smallest picture and of the largest one.
            Focal::FieldOfView(_) if ![1, MAX_EDGE as u32].iter().all(|&w| could_be(self.lens((w, w)).focal[0])) => {
                Some("no lens has so small a field of view")
            }
            _ if self.principal.is_some_and(|(x, y)| !((x as f32).is_finite() && (y as f32).is_finite())) => {
                Some("its principal point is not a number")
            }
            _ if !terms.iter().all(|k| k.is_finite()) => Some("a distortion coefficient is not a number"),
            _ => None,
        }
    }
}

/// A picture size as files write it.
pub(crate) fn picture_size(w: f64, h: f64) -> Option<(u32, u32)> {
    let edge = |v: f64| (1.0..=MAX_EDGE).contains(&v).then_some(v as u32);
    Some((edge(w)?, edge(h)?))
}

/// A camera model of COLMAP: number, name, whether it is a fisheye, and its parameters in order
/// (`src/colmap/sensor/models.h`; `q` are OpenCV's k4, k5, k6 of the denominator).
pub struct CameraModel {
    /// Number in binary files.
    pub id: u32,
    /// Name in text files and in `transforms.json`.
    pub name: &'static str,
    fisheye: bool,
    /// Names of its parameters.
    pub parameters: &'static [&'static str],
}

/// The models that can be read; of these, PINHOLE, OPENCV, FULL_OPENCV, OPENCV_FISHEYE and THIN_PRISM_FISHEYE are written.
pub const CAMERA_MODELS: &[CameraModel] = &[
    CameraModel { id: 0, name: "SIMPLE_PINHOLE", fisheye: false, parameters: &["f", "cx", "cy"] },
    CameraModel { id: 1, name: "PINHOLE", fisheye: false, parameters: &["fx", "fy", "cx", "cy"] },
    CameraModel { id: 2, name: "SIMPLE_RADIAL", fisheye: false, parameters: &["f", "cx", "cy", "k1"] },
    CameraModel { id: 3, name: "RADIAL", fisheye: false, parameters: &["f", "cx", "cy", "k1", "k2"] },
    CameraModel {
        id: 4,
        name: "OPENCV",
        fisheye: false,
        parameters: &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"],
    },
    CameraModel {
        id: 5,
        name: "OPENCV_FISHEYE",
        fisheye: true,
        parameters: &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
    },
    CameraModel {
        id: 6,
        name: "FULL_OPENCV",
        fisheye: false,
        parameters: &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "q1", "q2", "q3"],
    },
    CameraModel { id: 8, name: "SIMPLE_RADIAL_FISHEYE", fisheye: true, parameters: &["f", "cx", "cy", "k1"] },
    CameraModel { id: 9, name: "RADIAL_FISHEYE", fisheye: true, parameters: &["f", "cx", "cy", "k1", "k2"] },
    CameraModel {
        id: 10,
        name: "THIN_PRISM_FISHEYE",
        fisheye: true,
        parameters: &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"],
    },
];

impl CameraModel {
    /// The model of this number.
    pub fn numbered(id: u32) -> Option<&'static Self> {
        CAMERA_MODELS.iter().find(|m| m.id == id)
    }

    /// The model of this name.
    pub fn named(name: &str) -> Option<&'static Self> {
        CAMERA_MODELS.iter().find(|m| m.name == name)
    }

    /// Names of all models, for messages.
    pub fn names() -> String {
        CAMERA_MODELS.iter().map(|m| m.name).collect::<Vec<_>>().join(", ")
    }

    /// The lens with these parameters, in the model's order.
    ///
    /// # Errors
    /// What is wrong, in a few words.
    pub fn describe(&self, size: (u32, u32), values: &[f64]) -> Result<LensDescription, String> {
        if values.len() != self.parameters.len() {
            return Err(format!("{} takes {} parameters, not {}", self.name, self.parameters.len(), values.len()));
        }
        let of = |name: &str| self.parameters.iter().position(|p| *p == name).map(|i| values[i]);
        let term = |name: &str| of(name).unwrap_or(0.0);
        let (fx, fy) = match of("f") {
            Some(f) => (f, f),
            None => (term("fx"), term("fy")),
        };
        let distortion = Distortion {
            fisheye: self.fisheye,
            k1: term("k1"),
            k2: term("k2"),
            k3: term("k3"),
            k4: term("k4"),
            p1: term("p1"),
            p2: term("p2"),
            q1: term("q1"),
            q2: term("q2"),
            q3: term("q3"),
            sx1: term("sx1"),
            sy1: term("sy1"),
        };
        let lens = LensDescription {
            size: Some(size),
            focal: Focal::Pixels(fx, fy),
            principal: Some((term("cx"), term("cy"))),
            distortion,
        };
        match lens.fault() {
            None => Ok(lens),
            Some(fault) => Err(format!("impossible parameters {values:?}: {fault}")),
        }
    }

    /// The smallest model that is written and holds `lens`, with its parameters in order.
    ///
    /// # Errors
    /// COLMAP has no model with its terms (Metashape's k4 beside a perspective projection).
    pub fn holding(lens: &Lens) -> Result<(&'static Self, Vec<f64>), String> {
        let d = &lens.distortion;
        let value = |name: &str| match name {
            "fx" => lens.focal[0],
            "fy" => lens.focal[1],
            "cx" => lens.principal[0],
            "cy" => lens.principal[1],
            "k1" => d.k1,
            "k2" => d.k2,
            "k3" => d.k3,
            "k4" => d.k4,
            "p1" => d.p1,
            "p2" => d.p2,
            "q1" => d.q1,
            "q2" => d.q2,
            "q3" => d.q3,
            "sx1" => d.sx1,
            _ => d.sy1,
        };
        let terms = ["k1", "k2", "k3", "k4", "p1", "p2", "q1", "q2", "q3", "sx1", "sy1"];
        let holds = |m: &&CameraModel| {
            m.parameters[0] == "fx"
                && (d.is_none() || m.fisheye == d.fisheye)
                && terms.iter().all(|t| value(t) == 0.0 || m.parameters.contains(t))
        };
        let model = CAMERA_MODELS.iter().filter(holds).min_by_key(|m| m.parameters.len());
        model.map(|m| (m, m.parameters.iter().map(|p| value(p)).collect())).ok_or_else(|| {
            "no COLMAP camera model has the distortion of this lens; export to nerfstudio instead".to_owned()
        })
    }
}

/// An origin that a file claims.
pub(crate) fn origin(path: &Path, field: &str, lat: f64, lon: f64, alt: f64) -> Result<Geodetic, FormatError> {
    let origin = Geodetic { lat_deg: lat, lon_deg: lon, alt_m: alt };
    match origin.is_valid() {
        true => Ok(origin),
        false => Err(FormatError::invalid(path, format!("{field} is not a position on the earth"))),
    }
}

/// Refuses more shots than anybody has.
pub(crate) fn check_count(path: &Path, count: u64) -> Result<(), FormatError> {
    match count > MAX_SHOTS {
        true => Err(FormatError::TooLarge {
            path: path.to_owned(),
            what: "its number of pictures",
            size: count,
            limit: MAX_SHOTS,
        }),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(scale: f64, shift: DVec3) -> Vec<DVec3> {
        (0..12)
            .map(|i| shift + DVec3::new((0.5 * f64::from(i)).cos(), (0.5 * f64::from(i)).sin(), 0.1) * scale)
            .collect()
    }

    #[test]
    fn far_and_odd_sized_scenes_are_brought_near_and_others_stay_as_they_are() {
        for scale in [0.5, 3.1, 50.0, 4000.0] {
            assert_eq!(LocalFrame::of(&ring(scale, DVec3::splat(20.0 * scale))), None, "{scale}");
        }
        let utm = DVec3::new(500_000.0, 4_000_000.0, 100.0);
        for (scale, shift) in [(40.0, utm), (1e-4, DVec3::ZERO), (1e6, DVec3::ONE), (1e-4, utm), (0.03, DVec3::X)] {
            let places = ring(scale, shift);
            let frame = LocalFrame::of(&places).expect("moved");
            let own: Vec<DVec3> = places.iter().map(|p| frame.into_own(*p)).collect();
            assert!(own.iter().all(|p| p.length() < 1000.0) && own[0].distance(own[6]) > 0.5, "{scale}: {own:?}");
            let back = |(own, theirs): (&DVec3, &DVec3)| frame.into_theirs(*own).distance(*theirs);
            assert!(own.iter().zip(&places).map(back).all(|d| d <= 1e-9 * (scale + shift.length())), "{scale}");
            assert!(frame.is_usable() && !format!("{frame}").contains('\n'));
        }
        assert_eq!((LocalFrame::of(&[]), LocalFrame::of(&[utm, utm])), (None, None), "one place has no extent");
    }
}
