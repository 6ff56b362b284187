//! Bundler's file of cameras, version 0.3 (Snavely, Seitz and Szeliski 2006), with the list of pictures beside it. Cameras look along −z
//! with y upwards; places in pictures are counted from the middle.

use std::path::Path;

use geometry::lens::Distortion;
use glam::{DMat3, DVec3};
use models::formats::FormatError;
use models::formats::reconstruction::{Focal, LensDescription, Reconstruction};

use super::{LIMIT, from_opengl, is_rotation, shot};
use crate::coordinates::text;

const HEADER: &str = "# Bundle file v0.3";
/// Names of the list of pictures; `STEM.txt` is another.
const LISTS: [&str; 3] = ["list.txt", "list.rd.out.txt", "bundle.list.txt"];
/// More pictures than one survey has.
const MOST: usize = 100_000;

pub(super) fn is_one(head: &str) -> bool {
    head.trim_start().starts_with(HEADER)
}

/// Reads cameras and the list of pictures beside them.
///
/// # Errors
/// One of the two cannot be read, is damaged, or they differ in number.
pub(super) fn read(path: &Path) -> Result<Reconstruction, FormatError> {
    let bad = |what: String| FormatError::invalid(path, what);
    let whole = text(path, LIMIT)?;
    let mut numbers = whole.lines().filter(|l| !l.trim_start().starts_with('#')).flat_map(str::split_whitespace);
    let mut next = |what: &str| {
        let number = numbers.next().and_then(|n| n.parse::<f64>().ok()).filter(|v| v.is_finite());
        number.ok_or_else(|| bad(format!("ends, or holds no number, where {what} should be")))
    };
    let cameras = next("the number of cameras")?;
    next("the number of points")?;
    let list = list(path).ok_or_else(|| bad(format!("has no list of pictures beside it ({})", LISTS.join(", "))))?;
    let names: Vec<String> = text(&list, LIMIT)?
        .lines()
        .filter(|l| !l.trim().is_empty())
        // `NAME 0 FOCAL`: what follows the name is a first guess.
        .map(|line| line.trim().split(" 0 ").next().unwrap_or_default().to_owned())
        .collect();
    if names.len() > MOST || names.len() as f64 != cameras {
        return Err(bad(format!("has {cameras} cameras, and {} names {} pictures", list.display(), names.len())));
    }
    let (mut found, mut left) = (Reconstruction::default(), 0usize);
    for name in names {
        let what = format!("camera {:?}", name.chars().take(200).collect::<String>());
        let mut n = [0.0; 15];
        for value in &mut n {
            *value = next(&what)?;
        }
        let [f, k1, k2] = [n[0], n[1], n[2]];
        if f == 0.0 {
            left += 1;
            continue;
        }
        // Row by row, from the world to the camera.
        let to_world = DMat3::from_cols_slice(&n[3..12]);
        if !is_rotation(to_world) {
            return Err(bad(format!("{what}: its matrix does not only turn")));
        }
        let center = -(to_world * DVec3::new(n[12], n[13], n[14]));
        let distortion = Distortion { k1, k2, ..Distortion::default() };
        let lens = LensDescription { size: None, focal: Focal::Pixels(f, f), principal: None, distortion };
        found.shots.push(shot(name, lens, from_opengl(to_world), center));
    }
    if left > 0 {
        tracing::warn!("{}: {left} cameras without a pose are left out", path.display());
    }
    Ok(found)
}

fn list(path: &Path) -> Option<std::path::PathBuf> {
    let own = path.with_extension("txt");
    let others =
        LISTS.iter().flat_map(|name| [path.with_file_name(name), path.parent().unwrap_or(path).join("..").join(name)]);
    std::iter::once(own).chain(others).find(|p| p.is_file())
}
