//! Pix4D's Open Photogrammetry Format, 1.0 (github.com/Pix4D/opf-spec): a project file names the files of its cameras, their calibration
//! and the frame that they are in. Cameras look along −z with y upwards; the frame is a projection's metres, moved near zero.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use geometry::geodesy::EnuFrame;
use geometry::lens::Distortion;
use glam::{DMat3, DQuat, DVec3};
use models::formats::reconstruction::{Focal, LensDescription, Reconstruction};
use models::formats::{FormatError, read_bounded};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::{LIMIT, from_opengl, shot};
use crate::coordinates::Reference;

const PROJECT: &str = "application/opf-project+json";
const CAMERAS: &str = "application/opf-camera-list+json";
const CALIBRATED: &str = "application/opf-calibrated-cameras+json";
const FRAME: &str = "application/opf-scene-reference-frame+json";
/// A step that tells how a projection turns and scales, metres.
const STEP_M: f64 = 100.0;

#[derive(Deserialize)]
struct Project {
    items: Vec<Item>,
}

#[derive(Deserialize)]
struct Item {
    #[serde(default)]
    resources: Vec<Resource>,
}

#[derive(Deserialize)]
struct Resource {
    uri: String,
    format: String,
}

#[derive(Deserialize)]
struct List {
    cameras: Vec<Named>,
}

#[derive(Deserialize)]
struct Named {
    id: u64,
    uri: String,
}

#[derive(Deserialize)]
struct Calibrated {
    sensors: Vec<Sensor>,
    cameras: Vec<Camera>,
}

#[derive(Deserialize)]
struct Camera {
    id: u64,
    sensor_id: u64,
    position: [f64; 3],
    orientation_deg: [f64; 3],
}

#[derive(Deserialize)]
struct Sensor {
    id: u64,
    internals: Internals,
}

#[derive(Deserialize)]
struct Internals {
    #[serde(rename = "type")]
    kind: String,
    principal_point_px: [f64; 2],
    focal_length_px: Option<f64>,
    radial_distortion: Option<[f64; 3]>,
    tangential_distortion: Option<[f64; 2]>,
}

#[derive(Deserialize)]
struct Frame {
    crs: Crs,
    base_to_canonical: ToCanonical,
}

#[derive(Deserialize)]
struct Crs {
    definition: String,
}

#[derive(Deserialize)]
struct ToCanonical {
    shift: [f64; 3],
    scale: [f64; 3],
    swap_xy: bool,
}

pub(super) fn is_one(head: &str) -> bool {
    head.contains(PROJECT)
}

/// Reads a project's calibrated cameras.
///
/// # Errors
/// A file of it cannot be read or is damaged, lies outside of its folder, or a lens is not known.
pub(super) fn read(path: &Path) -> Result<Reconstruction, FormatError> {
    let bad = |what: String| FormatError::invalid(path, what);
    let project: Project = json(path)?;
    let resource = |format: &str| -> Result<Option<PathBuf>, FormatError> {
        let all = || project.items.iter().flat_map(|i| &i.resources);
        all().find(|r| r.format == format).map(|r| beside(path, &r.uri).map_err(bad)).transpose()
    };
    let calibrated = resource(CALIBRATED)?.ok_or_else(|| bad("is not calibrated yet: no calibrated cameras".into()))?;
    let list = resource(CAMERAS)?.ok_or_else(|| bad("has no list of cameras".into()))?;
    let names: HashMap<u64, String> = json::<List>(&list)?.cameras.into_iter().map(|c| (c.id, c.uri)).collect();
    let cameras: Calibrated = json(&calibrated)?;
    let mut lenses = HashMap::new();
    for sensor in &cameras.sensors {
        let what = |what: String| FormatError::invalid(&calibrated, format!("sensor {}: {what}", sensor.id));
        lenses.insert(sensor.id, lens(&sensor.internals).map_err(what)?);
    }
    let mut found = Reconstruction::default();
    for camera in &cameras.cameras {
        let bad = |what: &str| FormatError::invalid(&calibrated, format!("camera {}: {what}", camera.id));
        let name = names.get(&camera.id).ok_or_else(|| bad("is not in the list of cameras"))?;
        let lens = *lenses.get(&camera.sensor_id).ok_or_else(|| bad("has a sensor that is not there"))?;
        let [omega, phi, kappa] = camera.orientation_deg.map(f64::to_radians);
        let turn = DMat3::from_rotation_x(omega) * DMat3::from_rotation_y(phi) * DMat3::from_rotation_z(kappa);
        found.shots.push(shot(picture(name), lens, from_opengl(turn), camera.position.into()));
    }
    if let Some(frame) = resource(FRAME)? {
        onto_earth(&mut found, &json(&frame)?).map_err(|what| FormatError::invalid(&frame, what))?;
    }
    Ok(found)
}

fn json<T: DeserializeOwned>(path: &Path) -> Result<T, FormatError> {
    serde_json::from_slice(&read_bounded(path, LIMIT)?)
        .map_err(|e| FormatError::invalid(path, format!("not as the format says ({e})")))
}

/// A file of the project: never one outside of its folder.
fn beside(project: &Path, uri: &str) -> Result<PathBuf, String> {
    let name = uri.trim_start_matches("./");
    let inside = Path::new(name).components().all(|c| matches!(c, std::path::Component::Normal(_)));
    match inside && !name.contains(':') {
        true if name.contains(char::is_control) => Err(format!("{uri:?} is no name of a file")),
        true => Ok(project.with_file_name(name)),
        false => Err(format!("{uri:?} lies outside of the project's folder")),
    }
}

/// The picture's file: of an absolute place its name alone, without the page of a TIFF.
fn picture(uri: &str) -> String {
    let plain = uri.split('#').next().unwrap_or_default().replace("%20", " ");
    let absolute = plain.contains(':') || plain.starts_with('/') || plain.contains("..");
    if absolute { plain.rsplit(['/', '\\']).next().unwrap_or_default().to_owned() } else { plain }
}

fn lens(internals: &Internals) -> Result<LensDescription, String> {
    let f = match (internals.kind.as_str(), internals.focal_length_px) {
        ("perspective", Some(f)) => f,
        ("perspective", None) => return Err("it has no focal length".into()),
        (other, _) => return Err(format!("lenses of type {other:?} are not supported; perspective is")),
    };
    let [k1, k2, k3] = internals.radial_distortion.unwrap_or_default();
    // Pix4D's first tangential term is OpenCV's second.
    let [t1, t2] = internals.tangential_distortion.unwrap_or_default();
    let [cx, cy] = internals.principal_point_px;
    Ok(LensDescription {
        size: None,
        focal: Focal::Pixels(f, f),
        principal: Some((cx, cy)),
        distortion: Distortion { k1, k2, k3, p1: t2, p2: t1, ..Distortion::default() },
    })
}

/// From a projection's metres to east, north and up around the middle of the cameras. A frame that is nowhere on Earth stays.
fn onto_earth(found: &mut Reconstruction, frame: &Frame) -> Result<(), String> {
    let ToCanonical { shift, scale, swap_xy } = &frame.base_to_canonical;
    if !(scale.iter().all(|s| s.is_finite() && *s > 0.0) && shift.iter().all(|s| s.is_finite())) {
        return Err("its scale or shift is no number to work with".into());
    }
    let definition = &frame.crs.definition;
    if definition.trim_start().to_uppercase().starts_with("ENG") {
        return Ok(());
    }
    let reference = Reference::named(definition).ok_or("names a reference system that is not known")??;
    let base = |p: DVec3| {
        let moved = p - DVec3::from(*shift);
        let own = if *swap_xy { DVec3::new(moved.y, moved.x, moved.z) } else { moved };
        own / DVec3::from(*scale)
    };
    let outside = || "a camera lies outside of its reference system".to_owned();
    let geodetic = |p: DVec3| reference.geodetic(base(p)).ok_or_else(outside);
    let middle = found.shots.iter().map(|s| s.pose.center).sum::<DVec3>() / found.shots.len().max(1) as f64;
    let origin = geodetic(middle)?;
    let enu = EnuFrame::new(origin);
    for shot in &mut found.shots {
        let center = shot.pose.center;
        let place = enu.to_enu(geodetic(center)?);
        // North of the projection is not north.
        let north = enu.to_enu(geodetic(center + STEP_M * DVec3::Y)?) - place;
        let turn = DQuat::from_rotation_z(-north.x.atan2(north.y));
        shot.pose.center = place;
        shot.pose.rotation = (turn * shot.pose.rotation).normalize();
    }
    found.origin = Some(origin);
    Ok(())
}
