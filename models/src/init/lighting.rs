//! The light of the pictures, out of their depths: places that two pictures agree on, and the colours both have of them.

use std::io;

use rayon::prelude::*;

use super::depth_frame::{DepthFrame, DepthGrid};
use crate::camera::{Projector, Unprojector};
use crate::light::{Light, PictureLight, Ratio, Solved, off_axis, solve};

/// Places that a picture is compared with another at, at most.
const PLACES: usize = 128;
/// Depths of a picture that are looked for in another, at most: so many that places are left where a twentieth of them is seen.
const TRIED: usize = 20 * PLACES;
/// Confidence of a depth whose colour is compared.
const SURE: f32 = 0.2;
/// Half the side of the patch whose mean is compared, pixels of the network's picture: a misplaced texture averages out.
const PATCH: i32 = 3;
/// Means beyond these are clipped or noise.
const USABLE: [f32; 2] = [10.0, 245.0];
/// Light is uneven when this factor's logarithm is what gains and fall-off take off the differences of colours (their squares'
/// difference). sheffield_cross, a camera on auto in even weather, stays below; the same pictures changed by 40 % do not, and win by
/// it (`tests/tests/light.rs`).
const UNEVEN: f32 = 0.08;

/// Compares picture `i` with each of `others`.
pub(super) fn ratios(frames: &[DepthFrame], i: usize, others: &[usize], tolerance: f32) -> io::Result<Vec<Ratio>> {
    let Some(own) = frames[i].depth()? else { return Ok(Vec::new()) };
    let image = frames[i].image()?;
    let unproject = Unprojector::new(&frames[i].view);
    let sure: Vec<usize> = (0..own.depth.len()).filter(|k| own.confidence[*k] > SURE).collect();
    let every = sure.len().div_ceil(TRIED).max(1);
    let mut ratios = Vec::new();
    for &j in others {
        let Some(theirs) = frames[j].depth()? else { continue };
        let their_image = frames[j].image()?;
        let project = Projector::new(&frames[j].view);
        let seen = |at: usize| -> Option<(f32, f32)> {
            let (x, y) = own.pixel(at % own.width, at / own.width);
            let (u, v, z) = project.project(unproject.at(x, y, own.depth[at]))?;
            agrees(&theirs, (u, v, z), tolerance).then_some((u, v))
        };
        let both: Vec<(usize, (f32, f32))> =
            sure.iter().step_by(every).filter_map(|&at| Some((at, seen(at)?))).collect();
        for (at, (u, v)) in both.iter().step_by(both.len().div_ceil(PLACES).max(1)) {
            let (x, y) = own.pixel(at % own.width, at / own.width);
            let (Some(here), Some(there)) = (patch(&image, x, y), patch(&their_image, *u, *v)) else { continue };
            ratios.push(Ratio {
                pictures: [i as u32, j as u32],
                t2: [off_axis([x, y], &frames[i].view.intrinsics), off_axis([*u, *v], &frames[j].view.intrinsics)],
                log: std::array::from_fn(|c| (here[c] / there[c]).ln()),
            });
        }
    }
    Ok(ratios)
}

/// The gain of picture `i`, by those of `others` in `light`: the median of what their places in common say, if there are enough of
/// them.
pub(super) fn gain_of(
    frames: &[DepthFrame],
    i: usize,
    others: &[usize],
    light: &Light,
    tolerance: f32,
) -> io::Result<Option<[f32; 3]>> {
    let ratios = ratios(frames, i, others, tolerance)?;
    if ratios.len() < PLACES / 4 {
        return Ok(None);
    }
    let falloff = |t2: f32| light.lens_at(t2);
    let gain = std::array::from_fn(|c| {
        let mut all: Vec<f32> = ratios
            .iter()
            .map(|r| {
                let theirs = light.of(&frames[r.pictures[1] as usize].name).gain[c];
                r.log[c] - falloff(r.t2[0]) + falloff(r.t2[1]) + theirs
            })
            .collect();
        let middle = all.len() / 2;
        *all.select_nth_unstable_by(middle, f32::total_cmp).1
    });
    let usable = PictureLight { gain, ..light.of("") }.is_usable();
    Ok(usable.then_some(gain))
}

fn agrees(grid: &DepthGrid, (u, v, z): (f32, f32, f32), tolerance: f32) -> bool {
    let at = grid.index_at(u, v).filter(|k| grid.confidence[*k] > SURE);
    at.is_some_and(|k| ((z - grid.depth[k]) / grid.depth[k]).abs() < tolerance)
}

/// Mean colour around a place, 0…255; `None` at the rim and where a channel is clipped or dark.
fn patch(image: &image::RgbImage, x: f32, y: f32) -> Option<[f32; 3]> {
    let (x, y) = (x as i32, y as i32);
    let inside = |at: i32, size: u32| at >= PATCH && at + PATCH < size as i32;
    if !(inside(x, image.width()) && inside(y, image.height())) {
        return None;
    }
    let (mut sum, mut n) = ([0.0f32; 3], 0.0);
    for v in y - PATCH..=y + PATCH {
        for u in x - PATCH..=x + PATCH {
            let p = image.get_pixel(u as u32, v as u32).0;
            (0..3).for_each(|c| sum[c] += f32::from(p[c]));
            n += 1.0;
        }
    }
    let mean = sum.map(|s| s / n);
    mean.iter().all(|m| (USABLE[0]..=USABLE[1]).contains(m)).then_some(mean)
}

/// What was found, and what is to be done about it.
#[derive(Clone, Debug)]
pub(super) struct Found {
    pub solved: Solved,
    /// `None`: even, and nothing is to be done.
    pub light: Option<Light>,
}

/// The light of all pictures, each compared with those that `others` names.
pub(super) fn measure(
    frames: &[DepthFrame],
    others: impl Fn(usize) -> Vec<usize> + Sync,
    tolerance: f32,
) -> io::Result<Found> {
    let compared: io::Result<Vec<Vec<Ratio>>> =
        (0..frames.len()).into_par_iter().map(|i| ratios(frames, i, &others(i), tolerance)).collect();
    let mut all: Vec<Ratio> = compared?.into_iter().flatten().collect();
    let solved = solve(frames.len(), &mut all);
    let names = frames.iter().zip(&solved.gains);
    let light = Light {
        gains: names.filter_map(|(frame, gain)| Some((frame.name.clone(), (*gain)?))).collect(),
        falloff: solved.falloff,
        reach: solved.reach,
    };
    let taken_off = (solved.before.powi(2) - solved.after.powi(2)).max(0.0).sqrt();
    let uneven = taken_off >= UNEVEN && frames.iter().all(|frame| light.of(&frame.name).is_usable());
    Ok(Found { solved, light: uneven.then_some(light) })
}
