//! Lines of equal height (marching squares, Lorensen and Cline 1987 in the plane), as GeoJSON and as a drawing.
//!
//! Lines run between the middles of pixels and end where the map holds no height: nothing is drawn across a hole.

use std::collections::HashMap;
use std::io::{self, Write};

use glam::{DVec2, DVec3};
use serde_json::json;
use survey::coordinates::Reference;

use crate::MeasureError;
use crate::heights::Heights;
use crate::written::{collection, place};

/// Levels at most: more lines than pixels between them are no contours.
const MOST_LEVELS: f64 = 10_000.0;
/// Every so many lines one is drawn thicker.
const MAIN: i64 = 5;
/// Closed lines around fewer squares than this are noise.
const LEAST_SQUARES: f64 = 16.0;

/// A line of equal height.
#[derive(Clone, Debug, PartialEq)]
pub struct Contour {
    /// Its number: height over the interval.
    level: i64,
    /// Its height, metres.
    pub height_m: f64,
    /// Places along it, map coordinates. Uphill is to its right.
    pub places: Vec<DVec2>,
    /// Its last place is joined to its first.
    pub closed: bool,
}

impl Contour {
    /// Whether it is one of those that maps draw thicker.
    pub fn is_main(&self) -> bool {
        self.level % MAIN == 0
    }
}

/// Draws the lines of a map every `interval_m` metres of height.
///
/// # Errors
/// The interval is no length, or far too small for this map.
pub fn draw(heights: &Heights, interval_m: f64) -> Result<Vec<Contour>, MeasureError> {
    let [w, h] = heights.size();
    let all = || (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).filter_map(|(x, y)| heights.at(x, y));
    let (low, high) = all().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), z| (a.min(z), b.max(z)));
    let levels = (high - low) / interval_m;
    if !(interval_m.is_finite() && interval_m > 0.0) || levels > MOST_LEVELS {
        return Err(MeasureError::Request(format!(
            "contours every {interval_m} m: give an interval above zero that leaves at most {MOST_LEVELS} lines of the {:.1} m of this map",
            high - low
        )));
    }
    Ok(lines(heights, interval_m, LEAST_SQUARES * heights.pixel_m2()))
}

/// The outlines of the pixels of `mask` that are 1; those around others within them go the other way. The mask begins at `first`,
/// in pixels of the grid.
pub(crate) fn outlines(grid: &Heights, first: DVec2, size: [usize; 2], mask: Vec<f32>) -> Vec<Vec<DVec2>> {
    let Some(mask) = grid.part_of(first, size, mask) else { return Vec::new() };
    let half = lines(&mask, 0.5, 0.0).into_iter().filter(|line| line.level == 1 && line.closed);
    half.map(|line| line.places).collect()
}

fn lines(heights: &Heights, interval_m: f64, least_m2: f64) -> Vec<Contour> {
    let [w, h] = heights.size();
    let mut segments: HashMap<i64, Vec<[(usize, DVec2); 2]>> = HashMap::new();
    for y in 0..h.saturating_sub(1) {
        for x in 0..w.saturating_sub(1) {
            square(heights, (x, y), interval_m, |level, segment| segments.entry(level).or_default().push(segment));
        }
    }
    let mut numbers: Vec<i64> = segments.keys().copied().collect();
    numbers.sort_unstable();
    let mut contours = Vec::new();
    for level in numbers {
        for (places, closed) in joined(&segments[&level]) {
            let places: Vec<DVec2> = places.into_iter().map(|p| heights.place(p)).collect();
            if !closed || geometry::polygon::signed_area(&places).abs() >= least_m2 {
                contours.push(Contour { level, height_m: level as f64 * interval_m, places, closed });
            }
        }
    }
    contours
}

/// The segments in the square between four pixels, from edge to edge: an edge is a pixel and the one right of it (even numbers) or
/// below it (odd ones).
fn square(heights: &Heights, (x, y): (usize, usize), interval: f64, mut take: impl FnMut(i64, [(usize, DVec2); 2])) {
    let w = heights.size()[0];
    // Clockwise from the north-western one, with the edge that leads to the next.
    let corners = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)];
    let edges = [2 * (y * w + x), 2 * (y * w + x + 1) + 1, 2 * ((y + 1) * w + x), 2 * (y * w + x) + 1];
    let mut z = [0.0; 4];
    for (z, (x, y)) in z.iter_mut().zip(corners) {
        let Some(height) = heights.at(x, y) else { return };
        *z = height;
    }
    let low = z.iter().copied().fold(f64::INFINITY, f64::min);
    let high = z.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    for level in (low / interval).floor() as i64..=(high / interval).ceil() as i64 {
        let at = level as f64 * interval;
        let above = z.map(|z| z >= at);
        let crossing = |k: usize| {
            let (a, b) = (z[k], z[(k + 1) % 4]);
            let [p, q] = [corners[k], corners[(k + 1) % 4]].map(|(x, y)| DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            (edges[k], p.lerp(q, ((at - a) / (b - a)).clamp(0.0, 1.0)))
        };
        // Edges on which the line comes in (from above to below, clockwise) and goes out.
        let ins: Vec<usize> = (0..4).filter(|k| above[*k] && !above[(k + 1) % 4]).collect();
        let outs: Vec<usize> = (0..4).filter(|k| !above[*k] && above[(k + 1) % 4]).collect();
        match (ins.as_slice(), outs.as_slice()) {
            (&[i], &[o]) => take(level, [crossing(i), crossing(o)]),
            (&[i, j], &[o, p]) => {
                // A saddle: the middle says which two belong together.
                let high_middle = z.iter().sum::<f64>() / 4.0 >= at;
                let after = |k: usize| if (k + 1) % 4 == o { o } else { p };
                let before = |k: usize| if (o + 1) % 4 == k { o } else { p };
                let mate = |k: usize| if high_middle { after(k) } else { before(k) };
                take(level, [crossing(i), crossing(mate(i))]);
                take(level, [crossing(j), crossing(mate(j))]);
            }
            _ => {}
        }
    }
}

/// Segments joined where they share an edge: lines, and whether they are closed.
fn joined(segments: &[[(usize, DVec2); 2]]) -> Vec<(Vec<DVec2>, bool)> {
    let from: HashMap<usize, usize> = segments.iter().enumerate().map(|(k, s)| (s[0].0, k)).collect();
    let into: std::collections::HashSet<usize> = segments.iter().map(|s| s[1].0).collect();
    let mut used = vec![false; segments.len()];
    let mut lines = Vec::new();
    let open = (0..segments.len()).filter(|k| !into.contains(&segments[*k][0].0));
    for start in open.chain(0..segments.len()) {
        if used[start] {
            continue;
        }
        let mut places = vec![segments[start][0].1];
        let mut at = Some(start);
        while let Some(k) = at.filter(|k| !std::mem::replace(&mut used[*k], true)) {
            places.push(segments[k][1].1);
            at = from.get(&segments[k][1].0).copied();
        }
        let closed = at == Some(start);
        if closed {
            places.pop();
        }
        lines.push((places, closed));
    }
    lines
}

/// Writes lines as GeoJSON (RFC 7946): in degrees with `reference`, else in the map's own metres, which a member `axes` says.
///
/// # Errors
/// Errors of `out`, or a place outside of the reference system.
pub fn write_geojson(out: &mut dyn Write, contours: &[Contour], reference: Option<&Reference>) -> io::Result<()> {
    write!(out, "{}", collection(reference))?;
    for (k, contour) in contours.iter().enumerate() {
        let ends = contour.closed.then(|| contour.places.first()).flatten();
        let places: io::Result<Vec<_>> = contour.places.iter().chain(ends).map(|p| place(p, reference)).collect();
        let feature = json!({
            "type": "Feature",
            "geometry": { "type": "LineString", "coordinates": places? },
            "properties": { "height_m": contour.height_m, "main": contour.is_main() },
        });
        write!(out, "{}{feature}", if k > 0 { ",\n" } else { "\n" })?;
    }
    writeln!(out, "\n]}}")
}

/// Writes lines as an ASCII DXF of release 12, which all drawing programs read: polylines at their height, in map coordinates, main
/// lines on a layer of their own.
///
/// # Errors
/// Errors of `out`.
pub fn write_dxf(out: &mut dyn Write, contours: &[Contour]) -> io::Result<()> {
    write!(out, "0\nSECTION\n2\nENTITIES\n")?;
    for contour in contours {
        let layer = if contour.is_main() { "CONTOURS_MAIN" } else { "CONTOURS" };
        let place = |p: DVec3| format!("10\n{:.3}\n20\n{:.3}\n30\n{:.3}\n", p.x, p.y, p.z);
        let corner = place(DVec3::new(0.0, 0.0, contour.height_m));
        write!(out, "0\nPOLYLINE\n8\n{layer}\n66\n1\n70\n{}\n{corner}", u8::from(contour.closed))?;
        for p in &contour.places {
            write!(out, "0\nVERTEX\n8\n{layer}\n{}", place(p.extend(contour.height_m)))?;
        }
        write!(out, "0\nSEQEND\n8\n{layer}\n")?;
    }
    write!(out, "0\nENDSEC\n0\nEOF\n")
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;

    /// Pixels of 1 m, rows from north to south, the middle at zero.
    fn map(side: usize, of: impl Fn(DVec2) -> f64) -> Heights {
        let corner = DVec2::new(-0.5, 0.5) * side as f64;
        let place = |i: usize| corner + DVec2::new((i % side) as f64 + 0.5, -((i / side) as f64) - 0.5);
        Heights::new(corner, 1.0, [side, side], (0..side * side).map(|i| of(place(i)) as f32).collect()).unwrap()
    }

    #[test]
    fn lines_around_a_cone_are_closed_circles_at_their_height() {
        let contours = draw(&map(81, |p| 40.0 - p.length()), 10.0).unwrap();
        let rings: Vec<_> = contours.iter().filter(|c| c.closed).collect();
        assert_eq!(rings.iter().map(|c| c.height_m).collect::<Vec<_>>(), [10.0, 20.0, 30.0]);
        for ring in rings {
            let radius = 40.0 - ring.height_m;
            assert!(ring.places.iter().all(|p| (p.length() - radius).abs() < 0.1));
            // Uphill to the right: clockwise around a hill.
            assert!(geometry::polygon::signed_area(&ring.places) < 0.0);
        }
        assert_eq!(
            contours.iter().filter(|c| c.is_main()).count(),
            contours.iter().filter(|c| c.height_m % 50.0 == 0.0).count()
        );
    }

    #[test]
    fn nothing_is_drawn_across_a_hole_and_specks_of_noise_are_left_out() {
        let contours = draw(&map(41, |p| if p.x.abs() < 3.0 { f64::NAN } else { p.y }), 5.0).unwrap();
        assert!(
            contours
                .iter()
                .all(|c| !c.closed && c.places.iter().all(|p| p.x.abs() >= 3.0 && (p.y - c.height_m).abs() < 1e-6))
        );
        assert_eq!(contours.iter().filter(|c| c.height_m == 5.0).count(), 2, "one on each side");
        assert_eq!(draw(&map(41, |p| if p.length() < 1.0 { 1.0 } else { 0.0 }), 0.7).unwrap(), []);
        assert!(
            draw(&map(9, |p| p.x), 0.0).is_err()
                && draw(&map(9, |p| p.x), f64::NAN).is_err()
                && draw(&map(9, |p| p.x), 1e-6).is_err()
        );
        assert_eq!(draw(&map(9, |_| f64::NAN), 1.0).unwrap(), []);
    }

    #[test]
    fn saddles_join_by_their_middle_and_no_line_is_lost() {
        for lift in [-0.2, 0.2] {
            let contours = draw(&map(21, |p| p.x * p.y / 10.0 + lift), 100.0).unwrap();
            let ends = |p: DVec2| p.x.abs() > 9.4 || p.y.abs() > 9.4;
            assert_eq!(contours.len(), 2, "{lift}");
            assert!(contours.iter().all(|c| ends(c.places[0]) && ends(*c.places.last().unwrap())), "{lift}");
        }
    }

    #[test]
    fn both_files_hold_every_line_once() {
        let contours = draw(&map(81, |p| 40.0 - p.length()), 10.0).unwrap();
        let (mut json, mut dxf) = (Vec::new(), Vec::new());
        write_geojson(&mut json, &contours, None).unwrap();
        write_dxf(&mut dxf, &contours).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&json).unwrap();
        let dxf = String::from_utf8(dxf).unwrap();
        assert_eq!(json["features"].as_array().unwrap().len(), contours.len());
        assert_eq!(dxf.matches("\nPOLYLINE\n").count(), contours.len());
        assert_eq!(dxf.matches("\nVERTEX\n").count(), contours.iter().map(|c| c.places.len()).sum::<usize>());
        let mut earth = Vec::new();
        let system = Reference::named("EPSG:32632").unwrap().unwrap();
        let there: Vec<Contour> = contours
            .iter()
            .map(|c| Contour { places: c.places.iter().map(|p| *p + DVec2::new(5e5, 5.2e6)).collect(), ..c.clone() })
            .collect();
        write_geojson(&mut earth, &there, Some(&system)).unwrap();
        let earth: serde_json::Value = serde_json::from_slice(&earth).unwrap();
        assert!((earth["features"][0]["geometry"]["coordinates"][0][0].as_f64().unwrap() - 9.0).abs() < 0.01);
    }
}
