//! OpenSfM and OpenDroneMap: `reconstruction.json`, with `reference_lla.json` beside it in older versions. Lengths are in
//! units of the longer picture edge, measured from the middle; camera axes are OpenCV's, rotations angle-axis vectors from
//! world to camera; the world is east-north-up around `reference_lla`.

use std::collections::{BTreeMap, HashMap};
use std::io::BufReader;
use std::path::{Path, PathBuf};

use geometry::geodesy::Geodetic;
use geometry::lens::Distortion;
use glam::{DQuat, DVec3};
use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value, json};

use super::reconstruction::{Focal, LensDescription, Reconstruction, Shot, check_count, origin, picture_size};
use super::transforms::write_json;
use super::{FormatError, read_bounded, without_mark};
use crate::camera::Pose;

/// Where the file lies below the folder of a data set.
const PLACES: [&str; 3] =
    ["opensfm/reconstruction.json", "reconstruction.json", "opensfm/reconstruction.topocentric.json"];

#[derive(Deserialize)]
struct RawPart {
    #[serde(default)]
    cameras: HashMap<String, RawCamera>,
    #[serde(default)]
    shots: BTreeMap<String, RawShot>,
    reference_lla: Option<RawReference>,
}

#[derive(Deserialize)]
struct RawReference {
    latitude: f64,
    longitude: f64,
    altitude: f64,
}

#[derive(Deserialize)]
struct RawShot {
    rotation: [f64; 3],
    translation: [f64; 3],
    camera: String,
}

#[derive(Deserialize)]
struct RawPoint {
    coordinates: [f64; 3],
    #[serde(default)]
    color: [f64; 3],
}

#[derive(Deserialize)]
struct RawCamera {
    projection_type: String,
    width: f64,
    height: f64,
    focal: Option<f64>,
    focal_x: Option<f64>,
    focal_y: Option<f64>,
    #[serde(default)]
    c_x: f64,
    #[serde(default)]
    c_y: f64,
    #[serde(default)]
    k1: f64,
    #[serde(default)]
    k2: f64,
    #[serde(default)]
    k3: f64,
    #[serde(default)]
    k4: f64,
    #[serde(default)]
    p1: f64,
    #[serde(default)]
    p2: f64,
}

impl RawCamera {
    fn describe(&self) -> Result<LensDescription, String> {
        let size = picture_size(self.width, self.height).ok_or("its width and height must be between 1 and 65536")?;
        // What each projection has of the coefficients (`opensfm/src/geometry/camera_projections_functions.h`).
        let fisheye = matches!(self.projection_type.as_str(), "fisheye" | "fisheye_opencv");
        let (terms, tangential) = match self.projection_type.as_str() {
            "simple_radial" => (1, false),
            "perspective" | "radial" | "fisheye" => (2, false),
            "brown" => (3, true),
            "fisheye_opencv" => (4, false),
            other => {
                return Err(format!(
                    "projection_type {other:?} is not supported; simple_radial, perspective, radial, brown, fisheye, fisheye_opencv are"
                ));
            }
        };
        let term = |i: usize, k: f64| if i <= terms { k } else { 0.0 };
        let tangential = |p: f64| if tangential { p } else { 0.0 };
        let longer = f64::from(size.0.max(size.1));
        let fx = self.focal.or(self.focal_x).ok_or("it has neither focal nor focal_x")? * longer;
        let fy = self.focal.or(self.focal_y).map_or(fx, |f| f * longer);
        let lens = LensDescription {
            size: Some(size),
            focal: Focal::Pixels(fx, fy),
            principal: Some((0.5 * f64::from(size.0) + self.c_x * longer, 0.5 * f64::from(size.1) + self.c_y * longer)),
            distortion: Distortion {
                fisheye,
                k1: term(1, self.k1),
                k2: term(2, self.k2),
                k3: term(3, self.k3),
                k4: term(4, self.k4),
                p1: tangential(self.p1),
                p2: tangential(self.p2),
                ..Distortion::default()
            },
        };
        match lens.fault() {
            None => Ok(lens),
            Some(fault) => Err(fault.to_owned()),
        }
    }
}

/// The reconstruction that belongs to the data set in `root`.
pub fn find(root: &Path) -> Option<PathBuf> {
    PLACES.iter().map(|p| root.join(p)).find(|p| p.is_file())
}

/// Parses the file from front to back without holding it: points, the bulk of it, are passed over or taken one by one.
fn parse<'de, S: DeserializeSeed<'de>>(path: &Path, seed: S) -> Result<S::Value, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let mut json = serde_json::Deserializer::from_reader(BufReader::with_capacity(1 << 16, file));
    seed.deserialize(&mut json)
        .map_err(|e| FormatError::invalid(path, format!("not a reconstruction.json of OpenSfM: {e}")))
}

fn parts(path: &Path) -> Result<Vec<RawPart>, FormatError> {
    parse(path, std::marker::PhantomData)
}

/// Reads the largest part of `reconstruction.json`: parts are not connected, so that only one of them is a scene.
///
/// # Errors
/// The file cannot be read, is no such file, or says something impossible of a shot.
pub fn read(path: &Path) -> Result<Reconstruction, FormatError> {
    let mut parts = parts(path)?;
    let left_out: usize = parts.iter().map(|p| p.shots.len()).sum();
    parts.sort_by_key(|p| std::cmp::Reverse(p.shots.len()));
    let Some(part) = parts.into_iter().next() else {
        return Err(FormatError::invalid(path, "holds no reconstruction"));
    };
    if left_out > part.shots.len() {
        let rest = left_out - part.shots.len();
        tracing::warn!("{}: {rest} pictures lie in parts that are not connected and are left out", path.display());
    }
    check_count(path, part.shots.len() as u64)?;
    let origin = match &part.reference_lla {
        Some(r) => Some(origin(path, "reference_lla", r.latitude, r.longitude, r.altitude)?),
        None => beside(path)?,
    };
    let mut shots = Vec::with_capacity(part.shots.len());
    for (name, shot) in part.shots {
        let bad = |what: String| FormatError::invalid(path, format!("shot {name:?}: {what}"));
        let camera =
            part.cameras.get(&shot.camera).ok_or_else(|| bad(format!("camera {:?} is not there", shot.camera)))?;
        let lens = camera.describe().map_err(|e| bad(format!("camera {:?}: {e}", shot.camera)))?;
        let (r, t) = (DVec3::from_array(shot.rotation), DVec3::from_array(shot.translation));
        let rotation = DQuat::from_scaled_axis(r).conjugate();
        let pose = Pose { rotation, center: -(rotation * t) };
        // Of numbers, too: the length of a rotation by 1e308 is none.
        if !(pose.rotation.is_finite() && pose.center.is_finite()) {
            return Err(bad("its pose is not a number".to_owned()));
        }
        shots.push(Shot { path: name, lens, pose, mask: None });
    }
    Ok(Reconstruction { shots, origin })
}

/// Gives the points at finite positions of the largest part to `take`, with their colours, in the order of the file.
///
/// # Errors
/// As [`read`].
pub fn points(path: &Path, take: &mut dyn FnMut([f64; 3], [u8; 3])) -> Result<(), FormatError> {
    let largest =
        parts(path)?.iter().enumerate().max_by_key(|(i, p)| (p.shots.len(), std::cmp::Reverse(*i))).map(|p| p.0);
    let mut finite = |p: RawPoint| {
        if p.coordinates.iter().all(|v| v.is_finite()) {
            take(p.coordinates, p.color.map(|c| c.clamp(0.0, 255.0) as u8));
        }
    };
    parse(path, PointsOf { part: largest.unwrap_or(0), level: Level::Parts, take: &mut finite })
}

/// Walks down to the points of one part.
struct PointsOf<'t> {
    part: usize,
    level: Level,
    take: &'t mut dyn FnMut(RawPoint),
}

#[derive(Clone, Copy)]
enum Level {
    Parts,
    Part,
    Points,
}

impl<'de> DeserializeSeed<'de> for PointsOf<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, json: D) -> Result<(), D::Error> {
        match self.level {
            Level::Parts => json.deserialize_seq(self),
            Level::Part | Level::Points => json.deserialize_map(self),
        }
    }
}

impl<'de> Visitor<'de> for PointsOf<'_> {
    type Value = ();

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a list of reconstructions with points")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut parts: A) -> Result<(), A::Error> {
        for _ in 0..self.part {
            parts.next_element::<IgnoredAny>()?;
        }
        parts.next_element_seed(PointsOf { part: 0, level: Level::Part, take: &mut *self.take })?;
        while parts.next_element::<IgnoredAny>()?.is_some() {}
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        if matches!(self.level, Level::Points) {
            while let Some((_, point)) = map.next_entry::<IgnoredAny, RawPoint>()? {
                (self.take)(point);
            }
            return Ok(());
        }
        while let Some(key) = map.next_key::<String>()? {
            match key == "points" {
                true => map.next_value_seed(PointsOf { part: 0, level: Level::Points, take: &mut *self.take })?,
                false => drop(map.next_value::<IgnoredAny>()?),
            }
        }
        Ok(())
    }
}

fn beside(path: &Path) -> Result<Option<Geodetic>, FormatError> {
    let path = path.with_file_name("reference_lla.json");
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = read_bounded(&path, 1 << 16)?;
    let r: RawReference =
        serde_json::from_slice(without_mark(&bytes)).map_err(|e| FormatError::invalid(&path, e.to_string()))?;
    origin(&path, "its position", r.latitude, r.longitude, r.altitude).map(Some)
}

/// Writes `reconstruction.json` (and `reference_lla.json`, which older versions look for) into `folder`.
///
/// # Errors
/// The folder cannot be written to; a lens has no size, or terms that OpenSfM's projections do not have.
pub fn write(folder: &Path, reconstruction: &Reconstruction) -> Result<(), FormatError> {
    let (mut cameras, mut shots) = (Map::new(), Map::new());
    for shot in &reconstruction.shots {
        let bad = |what: &str| FormatError::invalid(folder, format!("{}: {what}", shot.path));
        let camera = camera(&shot.lens).map_err(bad)?;
        let name = match cameras.iter().find(|(_, c)| **c == camera) {
            Some((name, _)) => name.clone(),
            None => {
                let name = format!("dgtr {}", cameras.len() + 1);
                cameras.insert(name.clone(), camera);
                name
            }
        };
        let to_camera = shot.pose.rotation.conjugate();
        let (r, t) = (to_camera.to_scaled_axis().to_array(), (-(to_camera * shot.pose.center)).to_array());
        shots.insert(shot.path.clone(), json!({ "rotation": r, "translation": t, "camera": name }));
    }
    let mut part = json!({ "cameras": cameras, "shots": shots, "points": {} });
    if let Some(o) = reconstruction.origin {
        let reference = json!({ "latitude": o.lat_deg, "longitude": o.lon_deg, "altitude": o.alt_m });
        write_json(&folder.join("reference_lla.json"), &reference)?;
        part["reference_lla"] = reference;
    }
    write_json(&folder.join("reconstruction.json"), &json!([part]))
}

fn camera(lens: &LensDescription) -> Result<Value, &'static str> {
    let (w, h) = lens.size.ok_or("its size is not known")?;
    let (full, d) = (lens.lens((w, h)), lens.distortion);
    let longer = f64::from(w.max(h));
    let beyond = d.q1 != 0.0 || d.q2 != 0.0 || d.q3 != 0.0 || d.sx1 != 0.0 || d.sy1 != 0.0;
    if beyond || (d.fisheye && (d.p1 != 0.0 || d.p2 != 0.0)) || (!d.fisheye && d.k4 != 0.0) {
        return Err("no projection of OpenSfM has the distortion of this lens; export to nerfstudio instead");
    }
    Ok(json!({
        "projection_type": if d.fisheye { "fisheye_opencv" } else { "brown" }, "width": w, "height": h,
        "focal_x": full.focal[0] / longer, "focal_y": full.focal[1] / longer,
        "c_x": (full.principal[0] - 0.5 * f64::from(w)) / longer, "c_y": (full.principal[1] - 0.5 * f64::from(h)) / longer,
        "k1": d.k1, "k2": d.k2, "k3": d.k3, "k4": d.k4, "p1": d.p1, "p2": d.p2,
    }))
}
