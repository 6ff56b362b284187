//! Coordinates as files for other programs have them.

use std::io;

use glam::DVec2;
use survey::coordinates::Reference;

/// Decimals of a degree (a centimetre on the ground) and of a metre.
const DEGREE: f64 = 1e7;
const METRE: f64 = 1e3;

/// A place of the map: longitude and latitude with a reference system, the map's own metres without one.
///
/// # Errors
/// The place lies outside of the reference system.
pub(crate) fn place(p: &DVec2, reference: Option<&Reference>) -> io::Result<[f64; 2]> {
    let Some(reference) = reference else { return Ok([p.x, p.y].map(|v| (v * METRE).round() / METRE)) };
    let outside = || io::Error::new(io::ErrorKind::InvalidData, "a place outside of the map's reference system");
    let at = reference.geodetic(p.extend(0.0)).ok_or_else(outside)?;
    Ok([at.lon_deg, at.lat_deg].map(|v| (v * DEGREE).round() / DEGREE))
}

/// Begins a FeatureCollection (RFC 7946); without a reference system a member `axes` says what its coordinates are.
pub(crate) fn collection(reference: Option<&Reference>) -> String {
    let axes = if reference.is_some() { "" } else { "\"axes\":\"metres east and north\"," };
    format!("{{\"type\":\"FeatureCollection\",{axes}\"features\":[")
}
