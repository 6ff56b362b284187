//! The delivery encoding: a cloud rounded as coarsely as its pictures allow and entropy-coded, about a thirtieth of its exact
//! columns. For what goes to the ground and to viewers of `.dgtr`; training goes on from the exact ones.
//!
//! What is rounded how: a position on a grid of a fraction of the Gaussian's own size (`positions`), scales, rotation and
//! opacity by what shows (`shape`), colour as its mean over the directions of the training views and its variation in those
//! (`color`, `view_basis`). What is left is coded against predictions from the Gaussians before it (`predict`) by an adaptive
//! range coder (`coder`). Gaussians come back in another order. All of them: to leave out the faintest twentieth, as was tried, cost a town
//! of flat colours 0.8 dB for 5 % of its bytes.
//!
//! All numbers that the decoder steers by are sent along or follow from what it has read, by arithmetic that is the same on
//! every machine.

use config::upload::Encoding;
use glam::Vec3;

use crate::camera::View;
use crate::cloud::GaussianCloud;
use coder::{Coder, Decoder, Encoder};
use color::{ColorSteps, Colors};
use positions::{GridBounds, Tree};
use predict::Neighbours;
use shape::ShapeSteps;
use view_basis::ViewBasis;

mod cells;
mod coder;
mod color;
mod positions;
mod predict;
mod shape;
mod view_basis;

pub use cells::{CodedCell, CodedCells, Layer, encode_cells, round_shapes};
pub use coder::Garbled;

/// Host memory that encoding takes at most per Gaussian of SH degree 3, the cloud that is encoded not counted (measured:
/// `models/tests/delivery_memory.rs`).
pub const ENCODING_BYTES: usize = 900;
/// What a Gaussian takes on the disk at most: noise in every number needs 23 (the same test).
pub const ENCODED_BYTES: usize = 32;
/// And at least: what is read is bounded by the size of its file. Real scenes take 6 to 12; the words
/// of a scene that is more regular are filled up.
const LEAST_BYTES: u64 = 2;

/// Size classes at most; each is an octave.
const MAX_CLASSES: usize = 40;
/// A Gaussian's size: this share of the logarithm of its smallest axis, the rest of the middle one's.
const SMALLEST_SHARE: f64 = 0.33;
/// Gaussians at either end of the sizes that get no class of their own.
const OUTERMOST: f64 = 0.005;

/// How finely a cloud is rounded. Source of the defaults: a sweep of these steps over a model of sheffield_cross, bytes against
/// held-out PSNR; what they cost is in tests/BENCHMARKS.md.
#[derive(Clone, Copy, Debug)]
pub struct Rounding {
    /// Grid step of the middle size class, in standard deviations.
    pub position: f64,
    /// Power of the size that other classes' steps follow.
    pub position_power: f64,
    /// Scales, rotations, opacities.
    pub shape: ShapeSteps,
    /// Colours.
    pub color: ColorSteps,
    /// Of what training says against colours that vary with the view (`training.loss.view_dependence`), the share for a model that
    /// is rounded so: what varies less takes fewer bytes, and from near some of it is seen.
    pub view_dependence: f32,
}

impl Default for Rounding {
    fn default() -> Self {
        Self {
            position: 0.28,
            position_power: 0.5,
            shape: ShapeSteps { log_scale: 0.27, rotation_bits: 4, opacity_bits: 4 },
            color: ColorSteps { luma: 1.0 / 60.0, chroma: 1.6, variation: 0.016, by_importance: 0.3, rounding: 0.45 },
            view_dependence: 1.0,
        }
    }
}

impl Rounding {
    /// Nearly twice as finely for a third more bytes: for scenes seen from near, whose Gaussians are large in the pictures (the
    /// same sweep over a model of fox).
    pub fn fine() -> Self {
        Self {
            position: 0.17,
            position_power: 0.6,
            shape: ShapeSteps { log_scale: 0.15, rotation_bits: 5, opacity_bits: 6 },
            color: ColorSteps { luma: 1.0 / 96.0, chroma: 1.4, variation: 0.009, by_importance: 0.3, rounding: 0.5 },
            view_dependence: 0.35,
        }
    }

    /// What a model is rounded to that is sent so; `None`: it is sent as it was trained.
    pub fn of(encoding: Encoding) -> Option<Self> {
        match encoding {
            Encoding::Exact => None,
            Encoding::Delivery => Some(Self::default()),
            Encoding::Fine => Some(Self::fine()),
        }
    }
}

/// What an encoder takes from the whole cloud, so that a Gaussian is rounded the same in whichever cell it lies. It follows from
/// rounded scales alone: a cloud that was rounded before gives the same.
#[derive(Clone, Debug)]
struct Scope {
    /// The Gaussians that are kept.
    rows: Vec<u32>,
    /// Size classes, octaves, and the middle one.
    low: f64,
    high: f64,
    middle: f64,
}

/// Gaussians of one size class in coding order.
#[derive(Default)]
struct Class {
    /// Grid step, metres.
    step: f64,
    /// Outside the bounds: as they are.
    outliers: Vec<Vec3>,
    /// Sorted Morton codes of the others.
    cells: Vec<u64>,
    /// Rows of the cloud, outliers first.
    rows: Vec<u32>,
}

/// What an encoder knows beforehand.
struct Given<'a> {
    cloud: &'a GaussianCloud,
    views: &'a [View],
    rounding: Rounding,
    bounds: GridBounds,
    classes: Vec<Class>,
}

/// The words of some rows of a cloud.
fn encode_rows(
    cloud: &GaussianCloud,
    views: &[View],
    rounding: &Rounding,
    scope: &Scope,
    rows: &[u32],
) -> Result<Vec<u32>, Garbled> {
    let given = Given::new(cloud, views, *rounding, scope, rows);
    let mut encoder = Encoder::new();
    code(&mut encoder, rows.len(), cloud.sh_degree, Some(&given))?;
    Ok(encoder.finish())
}

/// Gaussians that so many bytes of words may hold.
pub fn most_gaussians(bytes: u64) -> u64 {
    bytes / LEAST_BYTES
}

/// The cloud of `n` Gaussians in `words`. The caller bounds `n`.
///
/// # Errors
/// [`Garbled`] for words that no encoder wrote.
pub fn decode(words: Vec<u32>, n: usize, sh_degree: u8) -> Result<GaussianCloud, Garbled> {
    code(&mut Decoder::new(words), n, sh_degree, None).map(|(cloud, _)| cloud)
}

/// Both directions: the cloud as a decoder has it, and an encoder's rows.
fn code(
    coder: &mut impl Coder,
    n: usize,
    sh_degree: u8,
    given: Option<&Given<'_>>,
) -> Result<(GaussianCloud, Vec<u32>), Garbled> {
    let rounding = given.map_or_else(Rounding::default, |g| g.rounding);
    let shape = rounding.shape.code(coder)?;
    let color = rounding.color.code(coder)?;
    let (places, rows) = places(coder, n, given)?;
    let means: Vec<Vec3> = places.iter().map(|p| p.mean).collect();
    let classes: Vec<u8> = places.iter().map(|p| p.class).collect();
    let neighbours = Neighbours::new(&means);

    let smallest = |row: &u32| {
        let cloud = given?.cloud;
        Some(shape::smallest_rotation(cloud.log_scales[*row as usize], cloud.rotations[*row as usize]))
    };
    let turned: Option<Vec<_>> = given.and_then(|_| rows.iter().map(smallest).collect());
    let scales: Option<Vec<_>> = turned.as_ref().map(|t| t.iter().map(|(s, _)| shape.round_scales(*s)).collect());
    let scales = shape::scales(coder, &neighbours, &classes, scales.as_deref())?;
    let vectors: Option<Vec<_>> = turned.map(|t| t.into_iter().map(|(_, v)| v).collect());
    let rotations = shape::rotations(coder, &shape, &scales, vectors.as_deref())?;
    let opacities: Option<Vec<_>> =
        given.map(|g| rows.iter().map(|r| shape.round_opacity(g.cloud.opacity_logits[*r as usize])).collect());
    let opacities = shape::opacities(coder, &shape, &neighbours, &scales, opacities.as_deref())?;

    let mut importance: Vec<f64> = (0..n).map(|i| shape.importance(scales[i], opacities[i])).collect();
    let middle = geometry::median(&mut importance.clone()).unwrap_or(0.0);
    importance.iter_mut().for_each(|v| *v -= middle);
    let coefficients = crate::cloud::sh_coefficients(sh_degree) - 1;
    let weights: Vec<f64> = given.map_or_else(Vec::new, |_| importance.iter().map(|v| v.exp2()).collect());
    let basis = match given {
        Some(g) => ViewBasis::of(coefficients, &means, &weights, g.views),
        None => ViewBasis::of(coefficients, &[], &[], &[]),
    };
    let basis = basis.code(coder)?;
    let stride = 3 * (coefficients + 1);
    let columns: Option<Vec<f32>> = given.map(|g| {
        rows.iter().flat_map(|r| &g.cloud.sh[*r as usize * stride..(*r as usize + 1) * stride]).copied().collect()
    });
    let colors = Colors { steps: color, basis: &basis, neighbours: &neighbours, importance: &importance };
    let sh = colors.code(coder, columns.as_deref())?;

    let cloud = GaussianCloud {
        sh_degree,
        means: means.iter().map(|m| m.to_array()).collect(),
        log_scales: scales.into_iter().map(|s| shape.log_scales(s)).collect(),
        rotations,
        opacity_logits: opacities.into_iter().map(|o| shape.opacity_logit(o)).collect(),
        sh,
    };
    Ok((cloud, rows))
}

/// A Gaussian of which only position and size class are known.
struct Place {
    mean: Vec3,
    class: u8,
}

/// Positions class by class, largest Gaussians first; gives them in the order of all that follows, with an encoder's rows.
fn places(coder: &mut impl Coder, n: usize, given: Option<&Given<'_>>) -> Result<(Vec<Place>, Vec<u32>), Garbled> {
    let bounds = given.map_or_else(|| GridBounds::of(&[]), |g| g.bounds).code(coder)?;
    let classes = coder.bits(6, given.map_or(0, |g| g.classes.len() as u64))? as usize;
    let mut places: Vec<(u64, Place)> = Vec::with_capacity(n);
    let mut tree = Tree::new();
    let none = Class::default();
    for at in (0..classes).rev() {
        let own = given.map_or(&none, |g| &g.classes[at]);
        let step = f64::from(coder.f32(own.step as f32)?);
        let room = (n - places.len()) as u64;
        let outliers = coder.bits(32, own.outliers.len() as u64)?;
        let members = coder.bits(32, own.cells.len() as u64)?;
        if !(step.is_finite() && step > 0.0) || outliers + members > room {
            return Err(Garbled);
        }
        let class = at as u8;
        let mut put = |mean: Vec3| places.push((bounds.rank(mean.as_dvec3()), Place { mean, class }));
        for i in 0..outliers as usize {
            let known = own.outliers.get(i).copied().unwrap_or_default();
            let mean = Vec3::new(coder.f32(known.x)?, coder.f32(known.y)?, coder.f32(known.z)?);
            if !mean.is_finite() {
                return Err(Garbled);
            }
            put(mean);
        }
        let grid = bounds.grid(step);
        for cell in tree.code(coder, &own.cells, members as u32, grid.bits())? {
            put(grid.center(cell).as_vec3());
        }
    }
    if places.len() != n {
        return Err(Garbled);
    }
    let mut order: Vec<u32> = (0..n as u32).collect();
    order.sort_by_key(|i| places[*i as usize].0);
    let rows: Vec<u32> = given.map_or_else(Vec::new, |g| {
        let all: Vec<u32> = g.classes.iter().rev().flat_map(|c| c.rows.iter().copied()).collect();
        order.iter().map(|i| all[*i as usize]).collect()
    });
    let mut places: Vec<Option<Place>> = places.into_iter().map(|(_, p)| Some(p)).collect();
    let sorted = order.iter().filter_map(|i| places[*i as usize].take()).collect();
    Ok((sorted, rows))
}

impl Scope {
    fn of(cloud: &GaussianCloud, rounding: &Rounding) -> Self {
        let rows: Vec<u32> = (0..cloud.len() as u32).filter(|i| cloud.is_valid(*i as usize)).collect();
        let mut sizes: Vec<f64> = rows.iter().map(|i| size(rounding, cloud.log_scales[*i as usize])).collect();
        sizes.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| sizes.get((share * sizes.len() as f64) as usize).or(sizes.last()).copied().unwrap_or(0.0);
        let (low, high) = (at(OUTERMOST).round(), at(1.0 - OUTERMOST).round());
        // Half octaves: a scene that goes on being trained keeps its grids.
        let middle = (2.0 * at(0.5)).round() / 2.0;
        Self { rows, low, high: high.min(low + MAX_CLASSES as f64 - 1.0), middle }
    }
}

/// A Gaussian's size in octaves, as its rounded scales say it.
fn size(rounding: &Rounding, log_scales: [f32; 3]) -> f64 {
    let mut steps = rounding.shape.round_scales(log_scales);
    steps.sort_unstable();
    let [small, middle, _] = steps.map(f64::from);
    (SMALLEST_SHARE * small + (1.0 - SMALLEST_SHARE) * middle) * rounding.shape.log_scale * std::f64::consts::LOG2_E
}

impl<'a> Given<'a> {
    fn new(cloud: &'a GaussianCloud, views: &'a [View], rounding: Rounding, scope: &Scope, rows: &[u32]) -> Self {
        let class_of =
            |row: &u32| size(&rounding, cloud.log_scales[*row as usize]).round().clamp(scope.low, scope.high);
        let lowest = rows.iter().map(class_of).fold(scope.high, f64::min);
        let highest = rows.iter().map(class_of).fold(lowest, f64::max);
        let count = (highest - lowest) as usize + 1;
        let means: Vec<Vec3> = rows.iter().map(|i| Vec3::from(cloud.means[*i as usize])).collect();
        let bounds = GridBounds::of(&means);
        let step = |class: usize| {
            let octaves = scope.middle + (lowest + class as f64 - scope.middle) * rounding.position_power;
            f64::from((rounding.position * octaves.exp2()) as f32)
        };
        let mut members: Vec<Vec<(u64, u32)>> = vec![Vec::new(); count];
        let mut classes: Vec<Class> = (0..count).map(|c| Class { step: step(c), ..Class::default() }).collect();
        for (row, mean) in rows.iter().zip(&means) {
            let class = (class_of(row) - lowest) as usize;
            if bounds.holds(*mean) {
                members[class].push((bounds.grid(classes[class].step).cell(*mean), *row));
            } else {
                classes[class].outliers.push(*mean);
                classes[class].rows.push(*row);
            }
        }
        for (class, mut members) in classes.iter_mut().zip(members) {
            members.sort_unstable();
            class.cells = members.iter().map(|(cell, _)| *cell).collect();
            class.rows.extend(members.iter().map(|(_, row)| *row));
        }
        Self { cloud, views, rounding, bounds, classes }
    }
}

#[cfg(test)]
mod tests;
