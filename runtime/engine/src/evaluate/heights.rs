//! Heights of a model's map against points whose height is known.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DQuat, DVec2, DVec3};
use models::camera::Pose;
use models::formats::model::ModelHeader;
use serde::Serialize;
use survey::dataset::Dataset;
use survey::ortho::check_points;
use survey::ortho::files::NO_HEIGHT;
use survey::ortho::grid::{BLOCK, Block};
use survey::ortho::height_raster;
use vulkan::trainer::Trainer;

use crate::error::EngineError;
use crate::ortho::{DrawnBlock, Map};
use crate::transfer::PoseTransfer;

/// Pictures that a triangulated point must be seen in to be a reference.
const LEAST_TRACK: usize = 3;

/// How far a map's heights are off, metres; positive where the map is too high.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct HeightScores {
    /// Points on the map.
    pub points: usize,
    /// Points beside it, or where it has no height.
    pub missing: usize,
    /// Mean error.
    pub bias_m: f64,
    /// Root mean square.
    pub rmse_m: f64,
    /// Median of the sizes.
    pub median_abs_m: f64,
    /// 90 % are no farther off.
    pub le90_m: f64,
    /// How the map's standard deviations hold; none where no height has one.
    pub sigmas: Option<SigmaScores>,
}

/// How standard deviations hold against errors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SigmaScores {
    /// Heights that have one.
    pub points: usize,
    /// Their median, metres.
    pub median_m: f64,
    /// Share of the errors within one of them: 0.683 where errors are normal.
    pub within_one: f64,
    /// Within two: 0.954.
    pub within_two: f64,
}

/// A height that was compared, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Compared {
    /// The map's less the reference.
    pub error: f64,
    /// What the map says of its standard deviation.
    pub sigma: Option<f64>,
}

/// The points of a reference in the model's frame: a file of surveyed points, a raster of heights where `map` has ground, or a data
/// set's folder, whose triangulated points are carried along with its poses.
///
/// # Errors
/// The reference cannot be read or holds no point.
pub fn reference(path: &Path, header: &ModelHeader, map: &Map) -> Result<Vec<DVec3>, EngineError> {
    let is_raster = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("tif") || e.eq_ignore_ascii_case("tiff"));
    let points = match path.is_dir() {
        true => sparse_points(path, header)?,
        false if is_raster => height_raster::read(path, header.origin, map.grid().bounds()?)?,
        false => check_points::read(path, header.origin)?,
    };
    match points.is_empty() {
        true => Err(EngineError::Request(format!("{}: holds no points to compare heights with", path.display()))),
        false => Ok(points),
    }
}

fn sparse_points(folder: &Path, header: &ModelHeader) -> Result<Vec<DVec3>, EngineError> {
    let set = Dataset::open(folder)?;
    let transfer = PoseTransfer::between(&set, &header.views);
    let carried = |p: [f64; 3]| {
        let there = Pose { rotation: DQuat::IDENTITY, center: DVec3::from(p) };
        transfer.apply(&there).center
    };
    let points = set.sparse_points()?;
    let known = points.iter().filter(|p| p.frames.is_empty() || p.frames.len() >= LEAST_TRACK);
    Ok(known.map(|p| carried(p.position)).collect())
}

/// Draws the blocks of `map` that hold points and compares.
///
/// # Errors
/// The device fails.
pub fn compare(map: &Map, trainer: &mut Trainer, points: &[DVec3]) -> Result<HeightScores, EngineError> {
    let grid = map.grid();
    let [columns, rows] = grid.size();
    let mut by_block: BTreeMap<[u32; 2], Vec<(DVec2, f64)>> = BTreeMap::new();
    let mut missing = 0;
    for point in points {
        let at = grid.crs().to_map(*point)?;
        let pixel = grid.pixel(at.truncate());
        match pixel.cmpge(DVec2::ZERO).all() && pixel.x < f64::from(columns) && pixel.y < f64::from(rows) {
            true => by_block.entry([pixel.x as u32 / BLOCK, pixel.y as u32 / BLOCK]).or_default().push((pixel, at.z)),
            false => missing += 1,
        }
    }
    let (mut drawn, mut errors) = (DrawnBlock::default(), Vec::with_capacity(points.len()));
    for ([i, j], points) in by_block {
        let (x, y) = (i * BLOCK, j * BLOCK);
        let block = Block { x, y, width: BLOCK.min(columns - x), height: BLOCK.min(rows - y) };
        if !map.draw(trainer, block, &mut drawn)? {
            missing += points.len();
            continue;
        }
        for (pixel, height) in points {
            let at = (pixel.y as u32 - y) * block.width + (pixel.x as u32 - x);
            let of = |values: &[f32]| Some(values[at as usize]).filter(|v| *v != NO_HEIGHT).map(f64::from);
            match of(&drawn.heights) {
                None => missing += 1,
                Some(drawn_height) => {
                    errors.push(Compared { error: drawn_height - height, sigma: of(&drawn.height_sigmas) });
                }
            }
        }
    }
    Ok(HeightScores::of(&errors, missing))
}

impl HeightScores {
    /// Of what was compared, and the number of points that could not be.
    pub fn of(compared: &[Compared], missing: usize) -> Self {
        if compared.is_empty() {
            return Self { missing, ..Self::default() };
        }
        let n = compared.len() as f64;
        let errors = || compared.iter().map(|c| c.error);
        let sizes = sorted(errors().map(f64::abs));
        Self {
            points: compared.len(),
            missing,
            bias_m: errors().sum::<f64>() / n,
            rmse_m: (errors().map(|e| e * e).sum::<f64>() / n).sqrt(),
            median_abs_m: quantile(&sizes, 0.5),
            le90_m: quantile(&sizes, 0.9),
            sigmas: SigmaScores::of(compared),
        }
    }
}

impl SigmaScores {
    fn of(compared: &[Compared]) -> Option<Self> {
        let known = || compared.iter().filter_map(|c| c.sigma.map(|sigma| (c.error.abs(), sigma)));
        let sigmas = sorted(known().map(|(_, sigma)| sigma));
        let within =
            |times: f64| known().filter(|(size, sigma)| *size <= times * sigma).count() as f64 / sigmas.len() as f64;
        (!sigmas.is_empty()).then(|| Self {
            points: sigmas.len(),
            median_m: quantile(&sigmas, 0.5),
            within_one: within(1.0),
            within_two: within(2.0),
        })
    }
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut all: Vec<f64> = values.collect();
    all.sort_by(f64::total_cmp);
    all
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;

    #[test]
    fn the_figures_are_those_of_the_errors() {
        let of = |i: u32| Compared { error: f64::from(i) / 100.0 - 0.25, sigma: (i >= 25).then_some(0.25) };
        let compared: Vec<Compared> = (0..=100).map(of).collect();
        let s = HeightScores::of(&compared, 7);
        assert_eq!((s.points, s.missing), (101, 7));
        assert!((s.bias_m - 0.25).abs() < 1e-12, "{s:?}");
        assert!((s.rmse_m - (0.0625f64 + 0.085).sqrt()).abs() < 1e-9, "{s:?}");
        assert!((s.median_abs_m - 0.26).abs() < 0.02 && (s.le90_m - 0.65).abs() < 0.011, "{s:?}");
        let sigmas = s.sigmas.unwrap();
        assert_eq!((sigmas.points, sigmas.median_m), (76, 0.25));
        assert!((sigmas.within_one - 26.0 / 76.0).abs() < 1e-12 && (sigmas.within_two - 51.0 / 76.0).abs() < 1e-12);
        assert_eq!(HeightScores::of(&[], 3), HeightScores { missing: 3, ..Default::default() });
    }
}
