//! Metashape's `cameras.xml` (Agisoft Metashape user manual, appendix on camera models): cameras in a chunk's own frame, with OpenCV's
//! axes; the chunk's, or its component's, similarity brings them around the middle of the Earth, or into local metres.

use std::collections::HashMap;
use std::path::Path;

use geometry::lens::Distortion;
use glam::{DMat3, DQuat, DVec3};
use models::formats::reconstruction::{Focal, LensDescription, Reconstruction};
use models::formats::{FormatError, read_bounded};
use roxmltree::Node;

use super::{LIMIT, is_rotation, shot};
use crate::xml;

/// A skew that moves no corner of a picture by more than this is left out, pixels.
const SKEW_PX: f64 = 0.5;
/// No picture has a longer edge.
const MOST_PIXELS: u32 = 1 << 16;

pub(super) fn is_one(head: &str) -> bool {
    head.contains("<document") && head.contains("<chunk")
}

/// Reads the chunk with the most cameras.
///
/// # Errors
/// The file cannot be read or is damaged, or a lens is not known.
pub(super) fn read(path: &Path) -> Result<Reconstruction, FormatError> {
    let bad = |what: String| FormatError::invalid(path, what);
    let text = String::from_utf8(read_bounded(path, LIMIT)?).map_err(|_| bad("is no UTF-8".into()))?;
    let document = xml::parse(text.trim_start_matches('\u{feff}')).map_err(|e| bad(format!("no XML ({e})")))?;
    let chunks: Vec<Node<'_, '_>> = document.descendants().filter(|n| n.has_tag_name("chunk")).collect();
    let placed = |chunk: &Node<'_, '_>| cameras(*chunk).filter(|c| text_of(*c, "transform").is_some()).count();
    let chunk = chunks.iter().max_by_key(|c| placed(c)).ok_or_else(|| bad("holds no chunk".into()))?;
    if chunks.len() > 1 {
        tracing::warn!("{}: {} chunks; the one with the most cameras is read", path.display(), chunks.len());
    }
    let mut lenses = HashMap::new();
    for sensor in chunk.descendants().filter(|n| n.has_tag_name("sensor")) {
        let id = sensor.attribute("id").unwrap_or_default();
        lenses.insert(id, lens(sensor).map_err(|what| bad(format!("sensor {id}: {what}")))?);
    }
    let mut components = HashMap::new();
    for component in chunk.descendants().filter(|n| n.has_tag_name("component")) {
        let id = component.attribute("id").unwrap_or_default();
        components.insert(id, similarity(component).map_err(|what| bad(format!("component {id}: {what}")))?);
    }
    let whole = similarity(*chunk).map_err(|what| bad(format!("its chunk: {what}")))?;
    let (mut found, mut left) = (Reconstruction::default(), 0usize);
    for camera in cameras(*chunk) {
        let label = camera.attribute("label").unwrap_or_default().to_owned();
        let bad = |what: &str| bad(format!("camera {label:?}: {what}"));
        let lens = lenses.get(camera.attribute("sensor_id").unwrap_or_default()).copied().flatten();
        let off = matches!(camera.attribute("enabled"), Some("0" | "false"));
        let (Some(pose), Some(lens)) = (text_of(camera, "transform").filter(|_| !off), lens) else {
            left += 1;
            continue;
        };
        let m: [f64; 16] = numbers(pose).ok_or_else(|| bad("its transform is not sixteen numbers"))?;
        let rotation = DMat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
        if !is_rotation(rotation) {
            return Err(bad("its transform does not only turn and move"));
        }
        let component = components.get(camera.attribute("component_id").unwrap_or_default()).copied().flatten();
        let Similarity { turn, shift, scale } = component.or(whole).unwrap_or(Similarity::NONE);
        let center = turn * DVec3::new(m[3], m[7], m[11]) * scale + shift;
        let rotation = (DQuat::from_mat3(&turn) * DQuat::from_mat3(&rotation)).normalize();
        found.shots.push(shot(label, lens, rotation, center));
    }
    if left > 0 {
        tracing::warn!("{}: {left} cameras without a pose or a lens, or switched off, are left out", path.display());
    }
    Ok(found)
}

fn cameras<'a>(chunk: Node<'a, 'a>) -> impl Iterator<Item = Node<'a, 'a>> {
    chunk.descendants().filter(|n| n.has_tag_name("camera") && n.has_attribute("sensor_id"))
}

/// The text of a child element.
fn text_of<'a>(node: Node<'a, '_>, name: &str) -> Option<&'a str> {
    node.children().find(|n| n.has_tag_name(name))?.text().map(str::trim).filter(|text| !text.is_empty())
}

fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let all: Option<Vec<f64>> = text.split_whitespace().map(|n| n.parse().ok()).collect();
    all?.try_into().ok()
}

#[derive(Clone, Copy)]
struct Similarity {
    turn: DMat3,
    shift: DVec3,
    scale: f64,
}

impl Similarity {
    const NONE: Self = Self { turn: DMat3::IDENTITY, shift: DVec3::ZERO, scale: 1.0 };
}

fn similarity(node: Node<'_, '_>) -> Result<Option<Similarity>, &'static str> {
    let Some(transform) = node.children().find(|n| n.has_tag_name("transform")) else { return Ok(None) };
    let rotation: Option<[f64; 9]> = text_of(transform, "rotation").and_then(numbers);
    let translation: Option<[f64; 3]> = text_of(transform, "translation").and_then(numbers);
    let scale = text_of(transform, "scale").map_or(Some(1.0), |s| s.parse::<f64>().ok());
    let (Some(r), Some(t), Some(scale)) = (rotation, translation, scale) else {
        // A chunk that was never placed has an empty one.
        return if transform.children().any(|n| n.is_element()) { Err("its transform is damaged") } else { Ok(None) };
    };
    let turn = DMat3::from_cols_array(&r).transpose();
    if !is_rotation(turn) || scale <= 0.0 || !scale.is_finite() {
        return Err("its transform does not only turn, scale and move");
    }
    Ok(Some(Similarity { turn, shift: t.into(), scale }))
}

/// A sensor's lens; `None` where it was never calibrated.
fn lens(sensor: Node<'_, '_>) -> Result<Option<LensDescription>, String> {
    let calibrations = || sensor.children().filter(|n| n.has_tag_name("calibration"));
    let adjusted = calibrations().find(|n| n.attribute("class") == Some("adjusted"));
    let Some(calibration) = adjusted.or_else(|| calibrations().next_back()) else { return Ok(None) };
    let number = |name: &str| match text_of(calibration, name) {
        Some(text) => text.parse::<f64>().map_err(|_| format!("its {name} is no number")),
        None => Ok(0.0),
    };
    let resolution =
        [calibration, sensor].into_iter().find_map(|n| n.children().find(|c| c.has_tag_name("resolution")));
    let resolution = resolution.ok_or("it has no resolution")?;
    let edge = |name: &str| {
        resolution.attribute(name).and_then(|v| v.parse::<u32>().ok()).filter(|v| (1..=MOST_PIXELS).contains(v))
    };
    let (Some(w), Some(h)) = (edge("width"), edge("height")) else {
        return Err("its width and height must be between 1 and 65536".into());
    };
    let fisheye = match calibration.attribute("type").or(sensor.attribute("type")).unwrap_or("frame") {
        "frame" => false,
        "fisheye" | "equidistant_fisheye" => true,
        other => return Err(format!("lenses of type {other:?} are not supported; frame and fisheye are")),
    };
    // Old files have fx and fy, newer ones f and what x has more of it.
    let f = number("f")?;
    let (fx, fy) = if f > 0.0 { (f + number("b1")?, f) } else { (number("fx")?, number("fy")?) };
    let skew = number("b2")? + number("skew")?;
    if (skew * f64::from(h) / (2.0 * fy)).abs() > SKEW_PX {
        return Err(format!("a skew (b2) of {skew} is not supported; export undistorted pictures"));
    }
    let distortion = Distortion {
        fisheye,
        k1: number("k1")?,
        k2: number("k2")?,
        k3: number("k3")?,
        k4: number("k4")?,
        // Metashape's first tangential term is OpenCV's second.
        p1: number("p2")?,
        p2: number("p1")?,
        ..Distortion::default()
    };
    let principal = (0.5 * f64::from(w) + number("cx")?, 0.5 * f64::from(h) + number("cy")?);
    // Old files count the principal point from the corner.
    let principal = if f > 0.0 { principal } else { (number("cx")?, number("cy")?) };
    Ok(Some(LensDescription {
        size: Some((w, h)),
        focal: Focal::Pixels(fx, fy),
        principal: Some(principal),
        distortion,
    }))
}
