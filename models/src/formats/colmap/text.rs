//! `cameras.txt`, `images.txt`, `points3D.txt`.

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;

use super::entries::{ColmapImage, ColmapPoint, pose};
use crate::formats::FormatError;
use crate::formats::reconstruction::{CameraModel, LensDescription, check_count, picture_size};
use crate::formats::stream::Lines;

/// Bytes kept of a line: a name of 4 KiB, or a track of some hundred thousand images.
const LINE: usize = 1 << 20;

fn numbers<const N: usize>(cells: &[&str]) -> Option<[f64; N]> {
    let mut out = [0.0; N];
    for (v, c) in out.iter_mut().zip(cells.get(..N)?) {
        *v = c.parse().ok()?;
    }
    Some(out)
}

pub(super) fn cameras(path: &Path) -> Result<HashMap<u32, LensDescription>, FormatError> {
    let mut lines = Lines::open(path, LINE)?;
    let mut cameras = HashMap::new();
    while let Some(row) = lines.next_row()? {
        let cells: Vec<&str> = row.split_whitespace().collect();
        let [id, model, w, h, values @ ..] = cells.as_slice() else {
            return Err(lines.bad("a camera is `ID MODEL WIDTH HEIGHT PARAMETERS`"));
        };
        let Some(known) = CameraModel::named(model) else {
            let known = CameraModel::names();
            return Err(lines
                .bad(&format!("camera model {model} is not supported ({known} are): run colmap image_undistorter")));
        };
        let size = w.parse().ok().zip(h.parse().ok()).and_then(|(w, h)| picture_size(w, h));
        let values = values.iter().map(|v| v.parse::<f64>().ok()).collect::<Option<Vec<_>>>();
        let (Ok(id), Some(size), Some(values)) = (id.parse(), size, values) else {
            return Err(lines.bad("a number of this camera cannot be read"));
        };
        cameras.insert(id, known.describe(size, &values).map_err(|e| lines.bad(&e))?);
        check_count(path, cameras.len() as u64)?;
    }
    Ok(cameras)
}

pub(super) fn images(path: &Path) -> Result<Vec<ColmapImage>, FormatError> {
    let mut lines = Lines::open(path, LINE)?;
    let mut images = Vec::new();
    let mut next = lines.next_row()?;
    while let Some(row) = next {
        let image = image(&row).ok_or_else(|| lines.bad("an image is `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`"))?;
        images.push(image.map_err(|name| lines.bad(&format!("image {name:?} has no usable pose")))?);
        check_count(path, images.len() as u64)?;
        // Its keypoints, which may be none: an empty line. Some writers leave the line out.
        let line = lines.next_line()?.map(|line| line.trim().to_owned());
        next = match line {
            Some(line) if is_image(&line) => Some(line),
            Some(_) => lines.next_row()?,
            None => None,
        };
    }
    Ok(images)
}

/// `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, where a name may hold spaces; the name of one without a usable pose.
fn image(row: &str) -> Option<Result<ColmapImage, String>> {
    let mut rest = row;
    let mut v = [0.0; 9];
    for value in &mut v {
        let (cell, after) = rest.trim_start().split_once(char::is_whitespace)?;
        *value = cell.parse().ok()?;
        rest = after;
    }
    let name = rest.trim();
    if name.is_empty() {
        return None;
    }
    let pose = pose([v[1], v[2], v[3], v[4]], DVec3::new(v[5], v[6], v[7]));
    Some(
        pose.map(|pose| ColmapImage { id: v[0] as u32, name: name.to_owned(), camera_id: v[8] as u32, pose })
            .ok_or(name.to_owned()),
    )
}

/// Whether a line in the place of keypoints is the next image: these come in threes, all numbers.
fn is_image(line: &str) -> bool {
    let cells: Vec<&str> = line.split_whitespace().collect();
    let keypoints = cells.len().is_multiple_of(3) && cells.iter().all(|cell| cell.parse::<f64>().is_ok());
    !line.starts_with('#') && !keypoints && matches!(image(line), Some(Ok(_)))
}

pub(super) fn points(path: &Path, take: &mut dyn FnMut(ColmapPoint)) -> Result<(), FormatError> {
    let mut lines = Lines::open(path, LINE)?;
    while let Some(row) = lines.next_row()? {
        let cells: Vec<&str> = row.split_whitespace().collect();
        let colors = cells.get(4..7).and_then(|c| {
            let mut color = [0u8; 3];
            color.iter_mut().zip(c).try_for_each(|(v, c)| c.parse().map(|n| *v = n).ok())?;
            Some(color)
        });
        let error = cells.get(7).and_then(|c| c.parse().ok());
        let (Some([_, x, y, z]), Some(color), Some(error)) = (numbers::<4>(&cells), colors, error) else {
            return Err(lines.bad("a point is `ID X Y Z R G B ERROR TRACK`"));
        };
        let images = cells[8..].iter().step_by(2).filter_map(|c| c.parse().ok()).collect();
        take(ColmapPoint { position: DVec3::new(x, y, z), color, error, images });
    }
    Ok(())
}
