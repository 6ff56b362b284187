//! Levels of detail of a scene: their sizes, and how far each is from the whole scene where it takes its place.

use std::ops::Range;
use std::path::Path;
use std::time::Instant;

use glam::{DMat3, DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::{GaussianCloud, SH_C0};
use models::formats::FormatError;
use models::formats::model::{Chunks, ModelHeader, write_chunks};
use models::{levels, metrics};
use serde::Serialize;
use vulkan::trainer::Rendering;

use runtime::error::JobError;
use scene::{Painter, Scene};

mod scene;

/// Pictures that levels are compared in, and their focal length, pixels.
const SIZE: [u32; 2] = [640, 480];
const FOCAL: f64 = 1000.0;
/// The whole scene is drawn so many times larger and averaged: what is smaller than a pixel is drawn larger than it is.
const FINER: u32 = 4;
/// From where a voxel is a pixel, a half and a quarter of one.
pub const FARTHER: [f64; 3] = [1.0, 2.0, 4.0];
/// How steeply they look down, degrees below the horizon.
const DOWN_DEG: [f64; 3] = [90.0, 60.0, 40.0];
/// A scene of more is compared from the first of them alone: drawing it takes long.
const MOST_FROM_AFAR: usize = 2_000_000;
/// Metres between neighbours of the made-up ground, which begins at the origin and is a square.
pub const SPACING_M: f64 = 0.25;

/// One level.
#[derive(Clone, Debug, Serialize)]
pub struct Level {
    /// Gaussians.
    pub gaussians: u64,
    /// Side of its voxels, metres; 0 for the finest, which is the model.
    pub voxel_m: f64,
    /// Where such a voxel is a pixel wide, metres.
    pub distance_m: f64,
    /// Mean PSNR against the whole scene seen from [`FARTHER`] times there, dB; of a large scene from there only.
    pub psnr: Vec<f64>,
}

/// All levels of a scene, and what they took.
#[derive(Clone, Debug, Serialize)]
pub struct Levels {
    /// The finest first.
    pub levels: Vec<Level>,
    /// Leaves of ground.
    pub leaves: usize,
    /// Seconds until they were written.
    pub seconds: f64,
    /// Name of the device that drew them.
    pub device: String,
}

/// Writes a made-up scene of `gaussians`: hilly ground with fields, seen by nobody yet; the same number, the same scene, but for how much its
/// colours change with the direction.
///
/// # Errors
/// The operating system's.
pub fn write_scene(path: &Path, gaussians: usize, sh_degree: u8) -> Result<(), FormatError> {
    let side = (gaussians as f64).sqrt().ceil() as usize;
    let rows = |range: Range<usize>| {
        let mut cloud = GaussianCloud::with_capacity(sh_degree, range.len());
        let mut sh = vec![0.0; cloud.sh_stride()];
        for i in range {
            let (x, y) = (SPACING_M * (i % side) as f64, SPACING_M * (i / side) as f64);
            let hills = 6.0 * ((x / 90.0).sin() + (y / 70.0).cos());
            let field = ((x / 37.0).floor() + 3.0 * (y / 23.0).floor()).rem_euclid(5.0);
            let furrow = 0.06 * (x * 1.7 + y * 0.6).sin();
            let rgb =
                [0.30 + 0.08 * field, 0.42 + 0.05 * (4.0 - field), 0.25].map(|v| (v + furrow - 0.5) / f64::from(SH_C0));
            for (k, v) in sh.iter_mut().enumerate() {
                *v = match rgb.get(k) {
                    Some(v) => *v as f32,
                    // Anything small that is another number for each.
                    None => ((i * 40_503 + k * 9_973) % 4_099) as f32 * 1e-5 - 0.02,
                };
            }
            cloud.push(
                [x, y, hills].map(|v| v as f32),
                [0.55 * SPACING_M, 0.55 * SPACING_M, 0.02].map(|v| v.ln() as f32),
                [1.0, 0.0, 0.0, 0.0],
                3.0,
                &sh,
            );
        }
        cloud
    };
    write_chunks(path, &ModelHeader { mission: "levels".into(), ..Default::default() }, gaussians, sh_degree, &rows)
}

/// Writes the levels of `model` into `folder` and compares each, as it is before it is packed, with the whole scene. Neither the scene
/// nor a level is in memory as a whole.
///
/// # Errors
/// As `dgtr export --to streamed`; no device.
pub fn measure(model: &Path, folder: &Path, device: Option<&str>) -> Result<Levels, JobError> {
    let start = Instant::now();
    let chunks = Chunks::open(model)?;
    let mut scenes: Vec<Scene> = Vec::new();
    let written = levels::write_and_see(&chunks, folder, chunks.sh_degree, &mut |levels| {
        for (level, leaf) in levels.iter().enumerate() {
            if level == scenes.len() {
                scenes.push(Scene::create(folder, chunks.sh_degree)?);
            }
            scenes[level].push(leaf)?;
        }
        Ok(())
    })?;
    let seconds = start.elapsed().as_secs_f64();
    let mut painter = Painter::open(device, chunks.sh_degree, SIZE)?;
    let farther = if chunks.count > MOST_FROM_AFAR { &FARTHER[..1] } else { &FARTHER[..] };
    let middle = written.coarsest.middle().map(f64::from);
    let mut all = Vec::with_capacity(scenes.len());
    for (number, gaussians) in written.counts.iter().enumerate() {
        let voxel_m = if number == 0 { 0.0 } else { written.voxels_m[number - 1] };
        let mut level = Level { gaussians: *gaussians, voxel_m, distance_m: FOCAL * voxel_m, psnr: Vec::new() };
        for distance in farther.iter().filter(|_| number > 0).map(|f| f * level.distance_m) {
            let mut sum = 0.0;
            for view in views(middle, distance) {
                let expected = averaged(&painter.draw(&mut scenes[0], &finer(&view))?);
                sum += psnr_of_scene(&painter.draw(&mut scenes[number], &view)?, &expected);
            }
            level.psnr.push(sum / DOWN_DEG.len() as f64);
        }
        tracing::info!("level {number}: {gaussians} Gaussians, {:.2?} dB", level.psnr);
        all.push(level);
    }
    Ok(Levels { levels: all, leaves: written.leaves, seconds, device: painter.device() })
}

fn finer(view: &View) -> View {
    let k = &view.intrinsics;
    View { intrinsics: k.resized(FINER * k.width, FINER * k.height), pose: view.pose }
}

/// A picture of [`finer`]'s size at the size of the levels' pictures.
fn averaged(large: &Rendering) -> Rendering {
    let (width, height) = (large.width / FINER, large.height / FINER);
    let mut small = Rendering { width, height, ..Rendering::default() };
    let share = 1.0 / (FINER * FINER) as f32;
    let mean = |column: &[f32], channels: u32, x: u32, y: u32, c: u32| {
        let at = |i: u32| (channels * ((y * FINER + i / FINER) * large.width + x * FINER + i % FINER) + c) as usize;
        share * (0..FINER * FINER).map(|i| column[at(i)]).sum::<f32>()
    };
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        small.rgb.extend([0, 1, 2].map(|c| mean(&large.rgb, 3, x, y, c)));
        small.transmittance.push(mean(&large.transmittance, 1, x, y, 0));
    }
    small
}

/// PSNR over the pixels that the whole scene covers: from afar most of a picture is nothing, on which all
/// levels agree.
fn psnr_of_scene(level: &Rendering, whole: &Rendering) -> f64 {
    let covered = |i: &usize| whole.transmittance[*i] < 0.5;
    let of = |r: &Rendering| {
        (0..whole.transmittance.len())
            .filter(covered)
            .flat_map(|i| r.rgb[3 * i..3 * i + 3].to_vec())
            .collect::<Vec<_>>()
    };
    metrics::psnr(&of(level), &of(whole))
}

/// Cameras around `middle`, so far from it.
fn views(middle: [f64; 3], distance: f64) -> Vec<View> {
    let middle = DVec3::from_array(middle);
    let [width, height] = SIZE;
    let half = [width, height].map(|n| n as f32 / 2.0);
    let intrinsics = Intrinsics { width, height, fx: FOCAL as f32, fy: FOCAL as f32, cx: half[0], cy: half[1] };
    let view = |down: f64| {
        let (sin, cos) = down.to_radians().sin_cos();
        // From the south: x to the east, the picture's upper edge to the north.
        let forward = DVec3::new(0.0, cos, -sin);
        let below = DVec3::new(0.0, -sin, -cos);
        let rotation = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, below, forward));
        View { intrinsics, pose: Pose { rotation, center: middle - distance * forward } }
    };
    DOWN_DEG.map(view).to_vec()
}
