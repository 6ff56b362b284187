//! The ground that a heap stands on, or a pit is dug into, as far as its rim tells.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DVec2, DVec3};
use spade::{DelaunayTriangulation, FloatTriangulation, HasPosition, Point2, Triangulation};

use crate::MeasureError;
use crate::areas::Area;
use crate::heights::{Around, Heights};
use crate::noise::Noise;

/// Places on a rim at which heights are read, at most.
const MOST_ON_RIM: f64 = 4096.0;
/// Less of a rim seen than this, and it is no rim.
const LEAST_SEEN: f64 = 0.5;

/// A pixel on the rim has its middle at most so many pixels from a place on it.
const NEAR: f64 = 2.0;

/// How the ground below is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Level, at the lowest height of the rim.
    Lowest,
    /// A plane through the rim.
    Plane,
    /// Triangles between the rim's heights.
    Triangulated,
}

impl Kind {
    /// All, by their names.
    pub const NAMED: [(&'static str, Self); 3] =
        [("lowest", Self::Lowest), ("plane", Self::Plane), ("triangulated", Self::Triangulated)];
}

/// A place on the rim.
#[derive(Clone, Copy, Debug)]
struct Sample {
    place: DVec2,
    around: Around,
    /// Errors of one stretch of the rim are one.
    stretch: usize,
    index: usize,
}

impl HasPosition for Sample {
    type Scalar = f64;
    fn position(&self) -> Point2<f64> {
        Point2::new(self.place.x, self.place.y)
    }
}

/// A surface below an area. It is a sum of parameters times weights, so that what the parameters are worth says what it is worth.
pub struct Base {
    surface: Surface,
    sigma_m: f64,
    /// Pixels from one on to the first whose error is another.
    reach: i64,
}

enum Surface {
    /// A height, and by how many standard deviations the lowest of so many may lie too low.
    Level {
        height: f64,
        extreme: f64,
    },
    Plane {
        middle: DVec2,
        parameters: DVec3,
        covariance: DMat3,
    },
    /// Places farther than `near` from the rim, and outside of it, have no height.
    Triangles {
        net: DelaunayTriangulation<Sample>,
        samples: usize,
        near: f64,
    },
}

impl Base {
    /// Of the rim of `area` on the map.
    ///
    /// # Errors
    /// The map holds too little of the rim.
    pub fn of_rim(kind: Kind, area: &Area, heights: &Heights, noise: &Noise) -> Result<Self, MeasureError> {
        let samples = rim(area, heights, noise)?;
        let surface = match kind {
            Kind::Lowest => lowest(&samples),
            Kind::Plane => plane(&samples, noise.sigma_m).ok_or_else(|| {
                MeasureError::Request(format!("{}: its rim is one line: no plane goes through it", area.name))
            })?,
            Kind::Triangulated => {
                let count = samples.len();
                let net = DelaunayTriangulation::bulk_load(samples)
                    .map_err(|e| MeasureError::Request(format!("{}: its rim makes no triangles ({e})", area.name)))?;
                Surface::Triangles { net, samples: count, near: NEAR * heights.gsd() }
            }
        };
        Ok(Self { surface, sigma_m: noise.sigma_m, reach: (noise.pixels(heights).sqrt().round() as i64).max(1) })
    }

    /// Numbers that the surface depends on.
    pub fn parameters(&self) -> usize {
        match &self.surface {
            Surface::Level { .. } => 1,
            Surface::Plane { .. } => 3,
            Surface::Triangles { samples, .. } => *samples,
        }
    }

    /// Its height at a place, and what each parameter adds to it, which is given to `weigh`; `None` outside of the rim.
    pub fn at(&self, place: DVec2, mut weigh: impl FnMut(usize, f64)) -> Option<f64> {
        match &self.surface {
            Surface::Level { height, .. } => {
                weigh(0, 1.0);
                Some(*height)
            }
            Surface::Plane { middle, parameters, .. } => {
                let basis = (place - *middle).extend(1.0);
                (0..3).for_each(|k| weigh(k, basis[k]));
                Some(basis.dot(*parameters))
            }
            Surface::Triangles { net, near, .. } => {
                let at = Point2::new(place.x, place.y);
                let mut weights = Vec::with_capacity(3);
                net.barycentric().get_weights(at, &mut weights);
                if weights.is_empty() {
                    // The middle of a pixel on the rim may lie outside of it.
                    let nearest = net.nearest_neighbor(at)?;
                    if nearest.data().place.distance(place) <= *near {
                        weights.push((nearest.fix(), 1.0));
                    }
                }
                let mut height = None;
                for (vertex, weight) in &weights {
                    let vertex = net.vertex(*vertex);
                    let sample = vertex.data();
                    weigh(sample.index, *weight);
                    *height.get_or_insert(0.0) += weight * sample.around.height;
                }
                height
            }
        }
    }

    /// Variance of Σ weightₖ · parameterₖ.
    pub fn variance(&self, weights: &[f64]) -> f64 {
        let of_height = self.sigma_m * self.sigma_m;
        match &self.surface {
            Surface::Level { extreme, .. } => {
                weights.iter().map(|w| w * w).sum::<f64>() * of_height * extreme * extreme
            }
            Surface::Plane { covariance, .. } => match weights {
                &[a, b, c] => DVec3::new(a, b, c).dot(*covariance * DVec3::new(a, b, c)),
                _ => 0.0,
            },
            Surface::Triangles { net, .. } => {
                // By row and column.
                let mut pixels: BTreeMap<[i64; 2], f64> = BTreeMap::new();
                for vertex in net.vertices() {
                    let sample = vertex.data();
                    let weight = weights.get(sample.index).copied().unwrap_or(0.0);
                    for ([x, y], share) in sample.around.pixels {
                        *pixels.entry([y as i64, x as i64]).or_default() += weight * share;
                    }
                }
                together(&pixels, self.reach) * of_height
            }
        }
    }
}

/// Σ wᵢ·wⱼ·ρᵢⱼ, where the correlation of two pixels falls to nothing at a distance of `reach` pixels in rows or columns.
fn together(pixels: &BTreeMap<[i64; 2], f64>, reach: i64) -> f64 {
    let correlation = |off: i64| 1.0 - off.abs() as f64 / reach as f64;
    let of_one = |(&[y, x], weight): (&[i64; 2], &f64)| {
        let rows = y + 1 - reach..y + reach;
        let near = rows.flat_map(|row| pixels.range([row, x + 1 - reach]..[row, x + reach]));
        weight * near.map(|(&[v, u], other)| other * correlation(v - y) * correlation(u - x)).sum::<f64>()
    };
    pixels.iter().map(of_one).sum()
}

/// Heights along the outside of an area, a pixel or more apart.
fn rim(area: &Area, heights: &Heights, noise: &Noise) -> Result<Vec<Sample>, MeasureError> {
    let length = geometry::polygon::perimeter(&area.outside);
    let step = heights.gsd().max(length / MOST_ON_RIM);
    let reach = noise.reach_m.max(step);
    let mut samples: Vec<Sample> = Vec::new();
    let (mut asked, mut gone) = (0usize, 0.0);
    let next = area.outside.iter().cycle().skip(1);
    for (a, b) in area.outside.iter().zip(next) {
        let side = a.distance(*b);
        let parts = (side / step).ceil().max(1.0);
        for k in 0..parts as usize {
            let part = k as f64 / parts;
            let place = a.lerp(*b, part);
            asked += 1;
            if let Some(around) = heights.around(place) {
                let stretch = ((gone + part * side) / reach) as usize;
                samples.push(Sample { place, around, stretch, index: samples.len() });
            }
        }
        gone += side;
    }
    if samples.len() < 3 || (samples.len() as f64) < LEAST_SEEN * asked as f64 {
        return Err(MeasureError::Request(format!(
            "{}: the map holds {:.0} % of its rim; half is needed, or another map as the base",
            area.name,
            100.0 * samples.len() as f64 / asked.max(1) as f64
        )));
    }
    Ok(samples)
}

/// The lowest of many independent errors lies about √(2 ln n) of their standard deviations below their mean.
fn lowest(samples: &[Sample]) -> Surface {
    let height = samples.iter().map(|s| s.around.height).fold(f64::INFINITY, f64::min);
    let stretches = samples.iter().map(|s| s.stretch).collect::<BTreeSet<_>>().len();
    Surface::Level { height, extreme: (2.0 * (stretches as f64).ln()).sqrt().max(1.0) }
}

/// Least squares. What the rim is off the plane counts as error, too: a rim is seldom one.
fn plane(samples: &[Sample], sigma_m: f64) -> Option<Surface> {
    let middle = samples.iter().map(|s| s.place).sum::<DVec2>() / samples.len() as f64;
    let basis = |s: &Sample| (s.place - middle).extend(1.0);
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for s in samples {
        let b = basis(s);
        normal += DMat3::from_cols(b * b.x, b * b.y, b * b.z);
        right += b * s.around.height;
    }
    // The spread across the rim, against that along it.
    let (xx, yy, xy) = (normal.x_axis.x, normal.y_axis.y, normal.x_axis.y);
    if xx * yy - xy * xy <= 1e-12 * (xx + yy) * (xx + yy) {
        return None;
    }
    let inverse = normal.inverse();
    let parameters = inverse * right;
    let off: f64 = samples.iter().map(|s| (s.around.height - basis(s).dot(parameters)).powi(2)).sum();
    let free = samples.len().saturating_sub(3).max(1) as f64;
    let stretches = samples.iter().map(|s| s.stretch).collect::<BTreeSet<_>>().len();
    let together = samples.len() as f64 / stretches as f64;
    // What the places are off the plane; half of a pixel's variance at the least, as between two pixels.
    let variance = (off / free).max(0.5 * sigma_m * sigma_m) * together;
    Some(Surface::Plane { middle, parameters, covariance: inverse * variance })
}
