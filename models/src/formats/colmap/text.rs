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
    while let Some(row) = lines.next_row()? {
        // `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, where a name may hold spaces.
        let mut cells = row.splitn(10, ' ').map(str::trim);
        let first: Vec<&str> = cells.by_ref().take(9).collect();
        let (Some(name), Some(v)) = (cells.next(), numbers::<9>(&first)) else {
            return Err(lines.bad("an image is `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`"));
        };
        let Some(pose) = pose([v[1], v[2], v[3], v[4]], DVec3::new(v[5], v[6], v[7])) else {
            return Err(lines.bad(&format!("image {name:?} has no usable pose")));
        };
        images.push(ColmapImage { id: v[0] as u32, name: name.to_owned(), camera_id: v[8] as u32, pose });
        check_count(path, images.len() as u64)?;
        // Its keypoints, which may be none: an empty line.
        lines.next_line()?;
    }
    Ok(images)
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
