//! How much lies above and below the ground of an area.
//!
//! The volume is a sum of heights times pixels less a base, so that its variance is that of the sum: noise goes with the square root of
//! the number of independent patches, the base with the weights of its parameters, what all heights have in common with the area.

use std::io::{self, Write};
use std::ops::Range;

use geometry::polygon;
use glam::DVec2;
use serde::Serialize;

use crate::MeasureError;
use crate::areas::Area;
use crate::base::{Base, Kind};
use crate::heights::Heights;
use crate::noise::Noise;

/// Lines in a pixel on which the share of it inside an area is told; along each line it is exact.
const LINES: usize = 8;

/// A number and its standard deviation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Measured {
    /// The number.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// What lies above and below an area's ground.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Volume {
    /// The area's name.
    pub name: String,
    /// Its area, m².
    pub area_m2: f64,
    /// The part of it where the map, or the base, has no height, m². Nothing of it is in the volumes; their standard deviations
    /// say what it may hold.
    pub unseen_m2: f64,
    /// Above the base: what is to be cut, m³.
    pub cut_m3: Measured,
    /// Below the base: what is to be filled, m³.
    pub fill_m3: Measured,
    /// The first less the second, m³.
    pub net_m3: Measured,
    /// Highest place above the base, metres.
    pub highest_m: f64,
    /// Lowest, metres.
    pub lowest_m: f64,
}

/// The ground below.
pub enum Below<'a> {
    /// Told by the area's rim.
    Rim(Kind),
    /// Another map, and what its heights are worth.
    Map(&'a Heights, Noise),
}

/// Measures an area.
///
/// # Errors
/// The map holds nothing of it, or too little of its rim.
pub fn measure(area: &Area, heights: &Heights, noise: &Noise, below: &Below<'_>) -> Result<Volume, MeasureError> {
    let base = match below {
        Below::Rim(kind) => Some(Base::of_rim(*kind, area, heights, noise)?),
        Below::Map(..) => None,
    };
    let mut sums = [Sum::new(base.as_ref()), Sum::new(base.as_ref())];
    let (mut seen, mut squares) = (0.0, 0.0);
    let [mut highest, mut lowest] = [f64::NEG_INFINITY, f64::INFINITY];
    let variance = |noise: &Noise| noise.sigma_m * noise.sigma_m;
    // What the difference of one pixel is worth, for the part of either sum that is noise alone.
    let sigma = match below {
        Below::Rim(_) => variance(noise).sqrt(),
        Below::Map(_, its) => (variance(noise) + variance(its)).sqrt(),
    };
    inside(area, heights, |x, y, share| {
        let place = heights.place(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
        let m2 = share * heights.pixel_m2();
        let mut weights = Weights::default();
        let ground = match (&base, below) {
            (Some(base), _) => base.at(place, |k, w| weights.push(k, w)),
            (None, Below::Map(map, _)) => map.height(place),
            (None, Below::Rim(_)) => None,
        };
        let Some(above) = heights.at(x, y).zip(ground).map(|(z, ground)| z - ground) else { return };
        seen += m2;
        squares += m2 * above * above;
        (highest, lowest) = (highest.max(above), lowest.min(above));
        sums[usize::from(above < 0.0)].add(m2, above.abs(), &weights);
        let by_chance = m2 * sigma * exceeds(above.abs() / sigma);
        sums.iter_mut().for_each(|sum| sum.by_chance += by_chance);
    });
    if seen <= 0.0 {
        return Err(MeasureError::Request(format!("{}: the map holds no height in it", area.name)));
    }
    let area_m2 = area.area_m2();
    let unseen_m2 = (area_m2 - seen).max(0.0);
    let unseen = unseen_m2 * (squares / seen).sqrt();
    let patches = |m2: f64| {
        let one = |heights: &Heights, noise: &Noise| {
            let patch = noise.pixels(heights) * heights.pixel_m2();
            // Never more patches than there is area, and at least a part of one.
            m2 * m2.min(patch).max(heights.pixel_m2()) * variance(noise)
        };
        let bias = |noise: &Noise| (m2 * noise.bias_m).powi(2);
        match below {
            // What all heights of the map have in common is in its rim, too.
            Below::Rim(_) => one(heights, noise),
            Below::Map(map, its) => one(heights, noise) + one(map, its) + bias(noise) + bias(its),
        }
    };
    let of = |sum: &Sum| {
        let base = base.as_ref().map_or(0.0, |base| base.variance(&sum.weights));
        (patches(sum.m2) + base + sum.by_chance.powi(2) + unseen * unseen).sqrt()
    };
    let [cut, fill] = &sums;
    let both: Vec<f64> = cut.weights.iter().zip(&fill.weights).map(|(c, f)| c + f).collect();
    let net = (patches(seen) + base.as_ref().map_or(0.0, |base| base.variance(&both)) + unseen * unseen).sqrt();
    Ok(Volume {
        name: area.name.clone(),
        area_m2,
        unseen_m2,
        cut_m3: Measured { value: cut.m3, sigma: of(cut) },
        fill_m3: Measured { value: fill.m3, sigma: of(fill) },
        net_m3: Measured { value: cut.m3 - fill.m3, sigma: net },
        highest_m: highest.max(0.0),
        lowest_m: lowest.min(0.0),
    })
}

/// Writes `volumes` as a table with commas between its cells (RFC 4180), its first line the names of its columns.
///
/// # Errors
/// Errors of `out`.
pub fn write_table(out: &mut dyn Write, volumes: &[Volume]) -> io::Result<()> {
    writeln!(
        out,
        "name,area_m2,unseen_m2,cut_m3,cut_sigma_m3,fill_m3,fill_sigma_m3,net_m3,net_sigma_m3,highest_m,lowest_m"
    )?;
    for v in volumes {
        let name = disk::table::field(&v.name);
        let numbers = [v.cut_m3, v.fill_m3, v.net_m3].map(|m| format!("{:.3},{:.3}", m.value, m.sigma)).join(",");
        writeln!(out, "{name},{:.3},{:.3},{numbers},{:.3},{:.3}", v.area_m2, v.unseen_m2, v.highest_m, v.lowest_m)?;
    }
    Ok(())
}

/// What a pixel's base hangs on: three parameters at most.
#[derive(Default)]
struct Weights {
    of: [(usize, f64); 3],
    len: usize,
}

impl Weights {
    fn push(&mut self, parameter: usize, weight: f64) {
        if let Some(place) = self.of.get_mut(self.len) {
            *place = (parameter, weight);
            self.len += 1;
        }
    }
}

/// What lies on one side of the base.
struct Sum {
    m2: f64,
    m3: f64,
    /// How the sum follows the base's parameters.
    weights: Vec<f64>,
    /// Of it, what noise alone would give.
    by_chance: f64,
}

impl Sum {
    fn new(base: Option<&Base>) -> Self {
        Self { m2: 0.0, m3: 0.0, weights: vec![0.0; base.map_or(0, Base::parameters)], by_chance: 0.0 }
    }

    fn add(&mut self, m2: f64, off: f64, weights: &Weights) {
        self.m2 += m2;
        self.m3 += m2 * off;
        for (parameter, weight) in &weights.of[..weights.len] {
            self.weights[*parameter] += m2 * weight;
        }
    }
}

/// By how much the mean of |x| exceeds |mean of x| on one side: E[max(0, −d − ε)] for a normal ε of variance 1 and `d` ≥ 0, which is
/// φ(d) − d·Φ(−d).
fn exceeds(d: f64) -> f64 {
    if !(0.0..8.0).contains(&d) {
        return 0.0;
    }
    let density = (-0.5 * d * d).exp() / (2.0 * std::f64::consts::PI).sqrt();
    // Φ(−d) by Abramowitz and Stegun 26.2.17, within 7.5e-8.
    let t = 1.0 / (1.0 + 0.231_641_9 * d);
    let series = [1.330_274_429, -1.821_255_978, 1.781_477_937, -0.356_563_782, 0.319_381_530];
    let tail = density * series.iter().fold(0.0, |sum, c| (sum + c) * t);
    (density - d * tail).max(0.0)
}

/// Calls `take` with every pixel that lies in `area`, and its share in it.
fn inside(area: &Area, heights: &Heights, mut take: impl FnMut(usize, usize, f64)) {
    let [w, h] = heights.size();
    let rings: Vec<Vec<DVec2>> = area.rings().map(|ring| ring.iter().map(|p| heights.pixel(*p)).collect()).collect();
    let corners = || rings.iter().flatten();
    let rows = clamp(corners().map(|p| p.y), h);
    let columns = clamp(corners().map(|p| p.x), w);
    let mut shares = vec![0.0; columns.len()];
    let mut crossings: Vec<f64> = Vec::new();
    for y in rows {
        shares.fill(0.0);
        for line in 0..LINES {
            let at = y as f64 + (line as f64 + 0.5) / LINES as f64;
            crossings.clear();
            for ring in &rings {
                crossings.extend(polygon::crossings(ring, at));
            }
            crossings.sort_unstable_by(f64::total_cmp);
            for pair in crossings.as_chunks::<2>().0 {
                cover(&mut shares, columns.start, *pair);
            }
        }
        for (k, share) in shares.iter().enumerate().filter(|(_, share)| **share > 0.0) {
            take(columns.start + k, y, share / LINES as f64);
        }
    }
}

/// Pixels between the least and the greatest of `places`.
fn clamp(places: impl Iterator<Item = f64>, most: usize) -> Range<usize> {
    let (low, high) = places.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
    let pixel = |p: f64| p.clamp(0.0, most as f64) as usize;
    pixel(low.floor())..pixel(high.ceil())
}

/// Adds to pixels from `first` on the length of what lies between two places on a line.
fn cover(shares: &mut [f64], first: usize, [from, to]: [f64; 2]) {
    let (from, to) = (from - first as f64, to - first as f64);
    let pixels = clamp([from, to].into_iter(), shares.len());
    for x in pixels {
        let left = x as f64;
        shares[x] += (to.min(left + 1.0) - from.max(left)).max(0.0);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;
    use crate::heights::testing::rough;

    const GSD: f64 = 0.1;
    const SIDE: usize = 300;

    fn square(low: f64, high: f64) -> Area {
        let corners = [[low, low], [high, low], [high, high], [low, high]].map(DVec2::from);
        Area { name: "heap".into(), outside: corners.to_vec(), holes: vec![] }
    }

    /// A map of 30 m by 30 m.
    fn map(of: impl Fn(DVec2) -> f64, noise: &[f32]) -> Heights {
        let corner = DVec2::new(0.0, SIDE as f64 * GSD);
        let place = |i: usize| corner + DVec2::new((i % SIDE) as f64 + 0.5, -((i / SIDE) as f64) - 0.5) * GSD;
        let value = |i: usize| of(place(i)) as f32 + noise.get(i).copied().unwrap_or(0.0);
        Heights::new(corner, GSD, [SIDE, SIDE], (0..SIDE * SIDE).map(value).collect()).unwrap()
    }

    /// A cone of 3 m over a circle of 5 m: 25π m³.
    fn cone(p: DVec2) -> f64 {
        (3.0 * (1.0 - p.distance(DVec2::splat(15.0)) / 5.0)).max(0.0)
    }

    const CONE_M3: f64 = 25.0 * std::f64::consts::PI;

    #[test]
    fn a_cone_on_a_slope_has_its_volume_over_a_plane_and_over_triangles() {
        let exact = Noise { sigma_m: 1e-3, reach_m: GSD, bias_m: 0.0 };
        let heights = map(|p| cone(p) + 0.2 * p.x - 0.1 * p.y + 40.0, &[]);
        for kind in [Kind::Plane, Kind::Triangulated] {
            let v = measure(&square(8.03, 22.04), &heights, &exact, &Below::Rim(kind)).unwrap();
            assert!((v.net_m3.value / CONE_M3 - 1.0).abs() < 2e-3, "{v:?}");
            assert!((v.area_m2 - 14.01 * 14.01).abs() < 1e-9 && v.unseen_m2 < 1e-6, "{v:?}");
            assert!((v.highest_m - 3.0).abs() < 0.1 && v.lowest_m > -0.02, "{v:?}");
        }
        // From the lowest height of the rim on, the wedge of the slope counts, too.
        let v = measure(&square(8.0, 22.0), &heights, &exact, &Below::Rim(Kind::Lowest)).unwrap();
        let wedge = 14.0 * 14.0 * (0.2 * 7.0 + 0.1 * 7.0);
        assert!((v.net_m3.value / (CONE_M3 + wedge) - 1.0).abs() < 0.02, "{v:?}");
    }

    #[test]
    fn of_another_map_the_difference_counts_and_cut_and_fill_are_apart() {
        let exact = Noise { sigma_m: 1e-3, reach_m: GSD, bias_m: 0.0 };
        let before = map(|p| 5.0 + 0.1 * p.x, &[]);
        let after = map(|p| 5.0 + 0.1 * p.x + cone(p) - if p.x < 5.0 { 0.5 } else { 0.0 }, &[]);
        let v = measure(&square(1.0, 29.0), &after, &exact, &Below::Map(&before, exact)).unwrap();
        assert!((v.cut_m3.value / CONE_M3 - 1.0).abs() < 2e-3, "{v:?}");
        assert!((v.fill_m3.value - 4.0 * 28.0 * 0.5).abs() < 0.1, "{v:?}");
        assert!((v.net_m3.value - v.cut_m3.value + v.fill_m3.value).abs() < 1e-9);
    }

    #[test]
    fn two_of_three_volumes_are_within_their_standard_deviation_and_nearly_all_within_two() {
        for (blur, kind) in [(0, Kind::Plane), (2, Kind::Plane), (0, Kind::Triangulated), (2, Kind::Triangulated)] {
            let (mut one, mut two, mut sigmas, mut squares) = (0, 0, 0.0, 0.0);
            let seeds = 60;
            for seed in 0..seeds {
                let heights = map(|p| cone(p) + 0.05 * p.x, &rough([SIDE, SIDE], blur, 0.05, seed + 1));
                let reach_m = (2 * blur + 1) as f64 * GSD;
                let noise = Noise { sigma_m: 0.05, reach_m, bias_m: 0.0 };
                let v = measure(&square(9.0, 21.0), &heights, &noise, &Below::Rim(kind)).unwrap();
                let off = (v.net_m3.value - CONE_M3).abs();
                one += u32::from(off <= v.net_m3.sigma);
                two += u32::from(off <= 2.0 * v.net_m3.sigma);
                (sigmas, squares) = (sigmas + v.net_m3.sigma, squares + off * off);
            }
            let rms = (squares / f64::from(seeds as u32)).sqrt();
            let told = sigmas / f64::from(seeds as u32);
            assert!(one * 100 >= 58 * seeds as u32 && two * 100 >= 90 * seeds as u32, "{blur} {kind:?}: {one}, {two}");
            assert!((0.8..=1.6).contains(&(told / rms)), "{blur} {kind:?}: told {told}, is {rms}");
        }
    }

    #[test]
    fn the_lowest_place_of_a_level_rim_is_too_low_by_no_more_than_is_said() {
        for seed in 1..20 {
            let heights = map(cone, &rough([SIDE, SIDE], 1, 0.05, seed));
            let noise = Noise { sigma_m: 0.05, reach_m: 3.0 * GSD, bias_m: 0.0 };
            let v = measure(&square(9.0, 21.0), &heights, &noise, &Below::Rim(Kind::Lowest)).unwrap();
            assert!((v.net_m3.value - CONE_M3).abs() < 2.0 * v.net_m3.sigma, "{seed}: {v:?}");
        }
    }

    #[test]
    fn what_nobody_saw_is_in_the_doubt_and_not_in_the_volume() {
        let exact = Noise { sigma_m: 0.01, reach_m: GSD, bias_m: 0.0 };
        let whole = map(|p| cone(p) + 2.0, &[]);
        let holed = map(|p| if p.distance(DVec2::splat(15.0)) < 2.0 { f64::NAN } else { cone(p) + 2.0 }, &[]);
        let of = |heights: &Heights| measure(&square(9.0, 21.0), heights, &exact, &Below::Rim(Kind::Plane)).unwrap();
        let (whole, holed) = (of(&whole), of(&holed));
        assert!((holed.unseen_m2 - 4.0 * std::f64::consts::PI).abs() < 0.2, "{holed:?}");
        assert!(holed.net_m3.sigma > 5.0 * whole.net_m3.sigma && holed.net_m3.sigma > 4.0, "{holed:?}");
        let nothing = measure(&square(100.0, 110.0), &map(cone, &[]), &exact, &Below::Rim(Kind::Plane)).unwrap_err();
        assert!(nothing.to_string().contains("holds 0 % of its rim"), "{nothing}");
    }

    #[test]
    fn a_bias_goes_with_the_area_and_flat_ground_says_that_its_cut_is_noise() {
        let noise = Noise { sigma_m: 0.05, reach_m: GSD, bias_m: 0.02 };
        let (a, b) = (map(|_| 3.0, &rough([SIDE, SIDE], 0, 0.05, 1)), map(|_| 3.0, &rough([SIDE, SIDE], 0, 0.05, 2)));
        let v = measure(&square(5.0, 25.0), &a, &noise, &Below::Map(&b, noise)).unwrap();
        let bias = 400.0 * 0.02 * 2.0f64.sqrt();
        assert!((v.net_m3.sigma / bias - 1.0).abs() < 0.05 && v.net_m3.value.abs() < 2.0 * bias, "{v:?}");
        assert!(v.cut_m3.value > 5.0 && v.cut_m3.value < 2.0 * v.cut_m3.sigma, "{v:?}");
    }

    #[test]
    fn the_table_names_its_columns_and_no_name_becomes_a_formula() {
        let exact = Noise { sigma_m: 1e-3, reach_m: GSD, bias_m: 0.0 };
        let mut v = measure(&square(9.0, 21.0), &map(cone, &[]), &exact, &Below::Rim(Kind::Plane)).unwrap();
        v.name = "=1+1,\"a\"".into();
        let mut text = Vec::new();
        write_table(&mut text, &[v]).unwrap();
        let text = String::from_utf8(text).unwrap();
        let (head, row) = text.trim_end().split_once('\n').unwrap();
        assert!(row.starts_with("\"'=1+1,\"\"a\"\"\",144.000,"), "{row}");
        assert_eq!(head.split(',').count(), row.split(',').count() - 1, "the name holds a comma");
    }
}
