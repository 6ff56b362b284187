//! What is missing as GeoJSON (RFC 7946): one MultiPolygon for each gap, with what is known of it.

use std::io::{self, Write};

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec2;
use serde_json::{Value, json};

use super::CoverageMap;
use super::gaps::Gap;
use super::outline::{Polygon, polygons};

/// Decimals of a degree: a centimetre on the ground.
const DEGREE: f64 = 1e7;
/// Decimals of a metre.
const METRE: f64 = 1e3;

/// Writes `gaps` of `map` as a FeatureCollection. With `origin` its coordinates are longitude and latitude (WGS-84), as the
/// standard wants them; without one they are metres east and north, which a member `axes` of the file says.
///
/// # Errors
/// Errors of `out`.
pub fn write(out: &mut dyn Write, map: &CoverageMap, gaps: &[Gap], origin: Option<Geodetic>) -> io::Result<()> {
    let frame = origin.map(EnuFrame::new);
    let place = |p: &DVec2| match &frame {
        Some(frame) => {
            let at = frame.to_geodetic(p.extend(map.base_m()));
            [at.lon_deg, at.lat_deg].map(|v| (v * DEGREE).round() / DEGREE)
        }
        None => [p.x, p.y].map(|v| (v * METRE).round() / METRE),
    };
    // A ring ends with the corner it begins with.
    let ring = |corners: &Vec<DVec2>| corners.iter().chain(corners.first()).map(place).collect::<Vec<_>>();
    let polygon = |p: &Polygon| std::iter::once(&p.outside).chain(&p.holes).map(ring).collect::<Vec<_>>();
    let feature = |gap: &Gap| {
        let shape: Vec<_> = polygons(&gap.squares, map.grid()).iter().map(polygon).collect();
        json!({
            "type": "Feature",
            "geometry": { "type": "MultiPolygon", "coordinates": shape },
            "properties": {
                "kind": gap.kind.name(),
                "area_m2": gap.area_m2,
                "unseen_m2": gap.unseen_m2,
                "fewest_pictures": gap.pictures,
                "narrowest_angle_deg": (gap.angle_deg * 10.0).round() / 10.0,
                "sigma_z_m": gap.sigma_z_m.map(|s| (s * METRE).round() / METRE),
            },
        })
    };
    let (pictures, dropped) = map.pictures();
    let rules = map.rules();
    let mut file = json!({
        "type": "FeatureCollection",
        "features": gaps.iter().map(feature).collect::<Vec<Value>>(),
        "covered_share": map.covered_share(),
        "region_m2": map.area_m2(),
        "cell_m": map.grid().side_m,
        "pictures": pictures,
        "pictures_without_pose": dropped,
        "wanted": { "pictures": rules.pictures, "angle_deg": rules.angle_deg, "least_m2": rules.least_m2 },
    });
    if frame.is_none() {
        file["axes"] = "metres east and north of an origin that is not known, not longitude and latitude".into();
    }
    serde_json::to_writer_pretty(&mut *out, &file)?;
    out.write_all(b"\n")
}
