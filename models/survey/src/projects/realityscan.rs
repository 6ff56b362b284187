//! The table "internal/external camera parameters" of RealityScan and RealityCapture. Focal lengths are those of a film 36 mm wide;
//! the principal point is in units of the longer edge, from the middle; heading, pitch and roll turn a camera that looks down.

use std::collections::HashMap;
use std::path::Path;

use geometry::lens::Distortion;
use glam::{DMat3, DVec3};
use models::formats::FormatError;
use models::formats::reconstruction::{Focal, LensDescription, Reconstruction};

use super::{LIMIT, SizeOf, from_opengl, shot};
use crate::coordinates::text;

/// What every such table has.
const NEEDED: [&str; 8] = ["name", "x", "y", "alt", "heading", "pitch", "roll", "f"];
/// Film's width, mm.
const FILM_MM: f64 = 36.0;

pub(super) fn is_one(head: &str) -> bool {
    head.lines().find(|l| is_table(l)).is_some_and(|line| columns(line).is_some())
}

/// Not the line that only counts the cameras.
fn is_table(line: &str) -> bool {
    !line.trim().is_empty() && !line.starts_with("#cameras")
}

fn columns(line: &str) -> Option<HashMap<String, usize>> {
    let name = |cell: &str| cell.trim().trim_start_matches(['\u{feff}', '#']).to_lowercase();
    let all: HashMap<String, usize> = line.split(',').enumerate().map(|(i, cell)| (name(cell), i)).collect();
    NEEDED.iter().all(|n| all.contains_key(*n)).then_some(all)
}

/// Reads the table; pictures that are not there are left out.
///
/// # Errors
/// The file cannot be read, or a line of it is damaged.
pub(super) fn read(path: &Path, size_of: SizeOf<'_>) -> Result<Reconstruction, FormatError> {
    let text = text(path, LIMIT)?;
    let mut lines = text.lines().enumerate().filter(|(_, line)| is_table(line));
    let columns = lines.next().and_then(|(_, line)| columns(line));
    let columns = columns.ok_or_else(|| FormatError::invalid(path, "names no columns of cameras"))?;
    let (mut found, mut missing) = (Reconstruction::default(), 0usize);
    for (i, line) in lines {
        let bad = |what: String| FormatError::invalid(path, format!("line {}: {what}", i + 1));
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let cell = |name: &str| columns.get(name).and_then(|at| cells.get(*at)).copied();
        let number = |name: &str| match cell(name) {
            Some(cell) => {
                cell.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(|| bad(format!("{name} is no number")))
            }
            None if NEEDED.contains(&name) => Err(bad(format!("has no {name}"))),
            None => Ok(0.0),
        };
        let name = cell("name").unwrap_or_default().trim_matches('"').to_owned();
        let Some((w, h)) = size_of(&name) else {
            missing += 1;
            continue;
        };
        let longer = f64::from(w.max(h));
        let f = number("f")? / FILM_MM * longer;
        let distortion = Distortion {
            k1: number("k1")?,
            k2: number("k2")?,
            k3: number("k3")?,
            k4: number("k4")?,
            p1: number("t1")?,
            p2: number("t2")?,
            ..Distortion::default()
        };
        let principal = (0.5 * f64::from(w) + number("px")? * longer, 0.5 * f64::from(h) + number("py")? * longer);
        let lens =
            LensDescription { size: Some((w, h)), focal: Focal::Pixels(f, f), principal: Some(principal), distortion };
        let [heading, pitch, roll] = [number("heading")?, number("pitch")?, number("roll")?].map(f64::to_radians);
        let turn = DMat3::from_rotation_z(-heading) * DMat3::from_rotation_x(pitch) * DMat3::from_rotation_y(roll);
        let center = DVec3::new(number("x")?, number("y")?, number("alt")?);
        found.shots.push(shot(name, lens, from_opengl(turn), center));
    }
    if missing > 0 {
        tracing::warn!("{}: {missing} pictures of it are not there, and are left out", path.display());
    }
    Ok(found)
}
