//! Where an area and its take-off places lie, in metres around its middle.

use std::path::Path;

use fleet::ground::{Ground, Ring};
use fleet::obstacles::Obstacles;
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DVec2, DVec3};
use measure::areas::{self, Area};

use super::{Flying, SurveyError, in_file, setting};

/// Take-off places are no further from the area's middle, metres.
const FARTHEST_M: f64 = 50_000.0;

/// The area in degrees, its middle, and whether it is a fence that nobody may leave.
pub fn area(path: &Path) -> Result<(Area, Geodetic, bool), SurveyError> {
    let mut drawn = areas::read_degrees(path)?;
    if drawn.others > 0 {
        tracing::warn!("{}: {} features are no polygons and are left out", path.display(), drawn.others);
    }
    let (Some(area), 1) = (drawn.areas.first(), drawn.areas.len()) else {
        let names: Vec<&str> = drawn.areas.iter().take(3).map(|a| a.name.as_str()).collect();
        return Err(SurveyError::Request(format!(
            "{}: holds {} polygons ({}, …), and one is surveyed at a time; save that one by itself",
            path.display(),
            drawn.areas.len(),
            names.join(", ")
        )));
    };
    let middle = middle(area);
    Ok((drawn.areas.swap_remove(0), middle, drawn.fence))
}

/// The middle of the box around an area, also where it lies on both sides of the antimeridian.
fn middle(area: &Area) -> Geodetic {
    let first = area.outside.first().map_or(0.0, |p| p.x);
    let near = |p: &DVec2| DVec2::new(first + east(p.x - first), p.y);
    let corners = area.outside.iter().map(near);
    let (low, high) = corners.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), p| (l.min(p), h.max(p)));
    let middle = low.midpoint(high);
    // A ten-millionth of a degree is a centimetre.
    let [lon_deg, lat_deg] = [east(middle.x), middle.y].map(|v| (v * 1e7).round() / 1e7);
    Geodetic { lat_deg, lon_deg, alt_m: 0.0 }
}

/// An angle as one of -180 to 180 degrees.
fn east(deg: f64) -> f64 {
    (deg + 180.0).rem_euclid(360.0) - 180.0
}

/// The area in metres, and what is cut out of it.
pub fn placed(path: &Path, area: &Area, frame: &EnuFrame) -> Result<(Ground, Vec<Ring>), SurveyError> {
    let holes: Vec<Ring> = area.holes.iter().map(|hole| put(hole, frame)).collect();
    let ground = Ground::new(outside(area, frame), &holes).map_err(|e| in_file(path, e))?;
    Ok((ground, holes))
}

/// The area's outside in metres.
pub fn outside(area: &Area, frame: &EnuFrame) -> Ring {
    put(&area.outside, frame)
}

fn put(corners: &[DVec2], frame: &EnuFrame) -> Ring {
    corners.iter().map(|p| flat(frame, p.y, p.x)).collect()
}

/// A place in metres east and north. One beyond the horizon, which may lie below the origin, is as far as the straight way through Earth.
fn flat(frame: &EnuFrame, lat_deg: f64, lon_deg: f64) -> DVec2 {
    let at = frame.to_enu(Geodetic { lat_deg, lon_deg, alt_m: frame.origin().alt_m });
    match at.z > -FARTHEST_M {
        true => at.truncate(),
        false => at.truncate().normalize_or(DVec2::X) * at.length(),
    }
}

/// Places of one frame in another.
pub fn moved(from: &EnuFrame, to: &EnuFrame, places: Vec<DVec2>) -> Vec<DVec2> {
    let place = |p: DVec2| {
        let at = from.to_geodetic(DVec3::new(p.x, p.y, 0.0));
        flat(to, at.lat_deg, at.lon_deg)
    };
    places.into_iter().map(place).collect()
}

/// Where each aircraft takes off.
pub fn homes(
    flying: &Flying,
    frame: &EnuFrame,
    (ground, obstacles): (&Ground, &Obstacles),
    count: usize,
) -> Result<Vec<DVec2>, SurveyError> {
    let place = |[lat_deg, lon_deg]: &[f64; 2]| {
        let valid = Geodetic { lat_deg: *lat_deg, lon_deg: *lon_deg, alt_m: 0.0 }.is_valid();
        match valid.then(|| flat(frame, *lat_deg, *lon_deg)).filter(|p| p.length() < FARTHEST_M) {
            Some(p) if obstacles.shut_out(p) => Err(setting(
                "--take-off",
                format!("{lat_deg},{lon_deg}"),
                "inside the fence, a few metres from its sides, as no flight leaves it",
            )),
            Some(p) if obstacles.hold(p) => Err(setting(
                "--take-off",
                format!("{lat_deg},{lon_deg}"),
                format!("{} m (--clearance) from every hole of the area, and a little more", obstacles.clearance_m()),
            )),
            Some(p) => Ok(p),
            None => Err(setting(
                "--take-off",
                format!("{lat_deg},{lon_deg}"),
                "latitude and longitude near the area, degrees",
            )),
        }
    };
    match flying.take_off.as_slice() {
        [] => {
            // The corner with the shortest way to all of the area.
            let middle = ground.middle();
            let inside = obstacles.fence().unwrap_or(ground);
            let corners = inside.parts.iter().filter_map(|part| part.first()).flatten();
            let corners = corners.filter(|p| !obstacles.hold(**p));
            let nearest = corners.min_by(|a, b| a.distance(middle).total_cmp(&b.distance(middle)));
            Ok(vec![nearest.copied().unwrap_or(middle); count])
        }
        [one] => Ok(vec![place(one)?; count]),
        each if each.len() == count => each.iter().map(place).collect(),
        each => Err(setting(
            "--take-off",
            format!("was given {} times", each.len()),
            format!("given once, or once for each of {count} aircraft"),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ORIGIN: Geodetic = Geodetic { lat_deg: 0.0, lon_deg: 0.0, alt_m: 0.0 };

    #[test]
    fn longitudes_of_both_sides_of_the_antimeridian_are_neighbours() {
        let ring = [[179.999, 1.0], [-179.999, 1.0], [-179.999, 1.002], [179.999, 1.002]].map(DVec2::from).to_vec();
        let middle = middle(&Area { name: "atoll".into(), outside: ring.clone(), holes: Vec::new() });
        assert_eq!((middle.lat_deg, middle.lon_deg.abs()), (1.001, 180.0));
        let frame = EnuFrame::new(middle);
        let corners: Vec<DVec2> = ring.iter().map(|p| flat(&frame, p.y, p.x)).collect();
        assert!(corners.iter().all(|p| p.length() < 260.0) && corners[0].x < 0.0 && corners[1].x > 0.0, "{corners:?}");
    }

    #[test]
    fn the_other_side_of_the_earth_is_far() {
        let frame = EnuFrame::new(ORIGIN);
        assert!(flat(&frame, 0.0, 180.0).length() > 1e7 && flat(&frame, 0.01, 179.99).length() > 1e7);
        assert!((flat(&frame, 0.0, 0.001) - DVec2::new(111.3, 0.0)).length() < 0.1);
    }
}
