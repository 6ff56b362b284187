//! Cards settled as `dgtr train` settles them: pictures that hold together, seconds, what is left of their key points' errors, and how
//! far the poses are from a reference's and from what the pictures state.

use std::collections::HashMap;
use std::path::Path;
use std::time::Instant;

use config::refine::RefineSettings;
use glam::{DQuat, DVec3};
use models::align::similarity::{Similarity, umeyama};
use models::camera::Pose;
use models::formats::transforms;
use models::refine::{RefineError, Refiner};
use serde::Serialize;
use survey::card::CardOptions;
use survey::dataset::{Dataset, DatasetError};
use survey::settling::{Needs, Settlement, settle};

/// What one card came to.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Measured {
    /// Pictures of the card.
    pub pictures: usize,
    /// Those that hold together.
    pub tied: usize,
    /// Wall time.
    pub seconds: f64,
    /// Root mean square and median of what is left, pixels of the size at which pictures were matched.
    pub reprojection_px: [f64; 2],
    /// Focal length over the one that the pictures state, and radial terms.
    pub lens: [f64; 3],
    /// Horizontal and vertical distance from stated positions, root mean square over the nearer nine tenths, metres.
    pub from_stated_m: Option<[f64; 2]>,
    /// Difference of poses from a reference's once a similarity has brought them there.
    pub from_reference: Option<Difference>,
    /// Pictures left out, with the reason.
    pub untied: Vec<(String, String)>,
}

/// Root mean square and largest distance from a reference, metres (or its units), and angles, degrees.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Difference {
    /// Pictures that the reference knows.
    pub compared: usize,
    /// Root mean square distance.
    pub rms_m: f64,
    /// Largest distance and whose it is.
    pub worst_m: (f64, String),
    /// Root mean square angle.
    pub rms_deg: f64,
    /// Extent of the reference's places, for comparison.
    pub extent_m: f64,
}

/// Why a card could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum PosesError {
    /// The card or the reference is not readable.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The reference is not readable.
    #[error(transparent)]
    Reference(#[from] models::formats::FormatError),
    /// The network.
    #[error(transparent)]
    Refine(#[from] RefineError),
}

impl config::error::Error for PosesError {
    fn kind(&self) -> config::error::ErrorKind {
        match self {
            Self::Dataset(e) => e.kind(),
            Self::Reference(e) => e.kind(),
            Self::Refine(e) => e.kind(),
        }
    }
}

/// Settles the card in `folder`; `reference` is a transforms.json whose pictures have the same names, endings aside.
///
/// # Errors
/// The card or the reference cannot be read; no network.
pub fn measure(
    folder: &Path,
    reference: Option<&Path>,
    settings: &RefineSettings,
) -> Result<(Measured, Settlement), PosesError> {
    let set = Dataset::open_card(&[folder.to_owned()], &CardOptions::default())?;
    let Some(notes) = set.card.clone() else { return Ok((Measured::default(), Settlement::default())) };
    let clock = Instant::now();
    let found = settle(
        &set,
        &notes,
        settings,
        &mut Needs::<PosesError> {
            open: &mut |settings| Ok(Refiner::open(settings)?),
            control: &|_| Vec::new(),
            taken: &mut |_, _| {},
            cancelled: &|| false,
            fits: &|_| true,
        },
    )?;
    let seconds = clock.elapsed().as_secs_f64();
    let found = found.unwrap_or_default();
    let (solved, lens) = (&found.solved, &found.solved.shared);
    let mut measured = Measured {
        pictures: set.frames.len(),
        tied: found.settled.len(),
        seconds,
        reprojection_px: [solved.reprojection_rms_px, solved.reprojection_median_px],
        lens: [lens.focal_scale, lens.radial[0], lens.radial[1]],
        untied: found.untied.iter().map(|(name, why)| (name.clone(), why.to_string())).collect(),
        ..Measured::default()
    };
    if !found.floats {
        let stated =
            set.frames.iter().filter_map(|f| Some(f.prior?.pose.center - found.settled.get(&f.name)?.view.pose.center));
        let (mut flat, mut up): (Vec<f64>, Vec<f64>) = stated.map(|d| (d.truncate().length(), d.z.abs())).unzip();
        measured.from_stated_m = Some([near_rms(&mut flat), near_rms(&mut up)]);
    }
    if let Some(path) = reference {
        let stem =
            |name: &str| Path::new(name).file_stem().map(|s| s.to_string_lossy().to_lowercase()).unwrap_or_default();
        let truth: HashMap<String, Pose> =
            transforms::read(path)?.shots.into_iter().map(|s| (stem(&s.path), s.pose)).collect();
        let both: Vec<(&str, Pose, Pose)> = found
            .settled
            .iter()
            .filter_map(|(name, s)| Some((name.as_str(), s.view.pose, *truth.get(&stem(name))?)))
            .collect();
        measured.from_reference = difference(&both);
    }
    Ok((measured, found))
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0usize), |(sum, count), v| (sum + v * v, count + 1));
    (sum / count.max(1) as f64).sqrt()
}

/// Root mean square of the smaller nine tenths.
fn near_rms(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    rms(values.iter().copied().take(values.len() * 9 / 10))
}

/// `both`: name, found and true pose. Angles are compared in quarter turns of the picture: viewers turn pictures.
fn difference(both: &[(&str, Pose, Pose)]) -> Option<Difference> {
    let from: Vec<DVec3> = both.iter().map(|b| b.1.center).collect();
    let to: Vec<DVec3> = both.iter().map(|b| b.2.center).collect();
    let mut by = umeyama(&from, &to, None).ok()?;
    // One that is far off does not hide behind the others.
    for _ in 0..3 {
        let off: Vec<f64> = from.iter().zip(&to).map(|(a, b)| by.apply(*a).distance(*b)).collect();
        let mut sorted = off.clone();
        sorted.sort_by(f64::total_cmp);
        let usual = sorted[sorted.len() / 2].max(1e-9);
        let weights: Vec<f64> = off.iter().map(|o| 1.0 / (1.0 + (o / (3.0 * usual)).powi(2))).collect();
        by = umeyama(&from, &to, Some(&weights)).unwrap_or(by);
    }
    let away = |b: &(&str, Pose, Pose)| by.apply(b.1.center).distance(b.2.center);
    let turned = |b: &(&str, Pose, Pose), by: &Similarity| {
        let of = |k: u8| {
            let turn = DQuat::from_rotation_z(f64::from(k) * std::f64::consts::FRAC_PI_2);
            (by.rotation * b.1.rotation * turn).angle_between(b.2.rotation).to_degrees()
        };
        (0..4).map(of).fold(f64::INFINITY, f64::min)
    };
    let worst = both.iter().max_by(|a, b| away(a).total_cmp(&away(b)))?;
    let middle = to.iter().sum::<DVec3>() / to.len().max(1) as f64;
    Some(Difference {
        compared: both.len(),
        rms_m: rms(both.iter().map(away)),
        worst_m: (away(worst), worst.0.to_owned()),
        rms_deg: rms(both.iter().map(|b| turned(b, &by))),
        extent_m: to.iter().map(|p| p.distance(middle)).fold(0.0, f64::max),
    })
}
