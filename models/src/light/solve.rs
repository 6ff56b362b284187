//! Gains and fall-off out of the colours that pictures have of the same places: robust least squares on a graph whose edges are
//! overlaps, solved by conjugate gradients. Memory: a sum per overlap.

use super::FALLOFF_TERMS;

/// Times that the weights of the ratios are found anew.
const ROUNDS: usize = 6;
/// Residuals of this many median residuals count half.
const OUTLIER: f64 = 2.0;
/// What holds gains near 0 where nothing else does, in ratios.
const GAIN_PRIOR: f64 = 0.05;
/// What holds the fall-off's terms near 0 at the reach.
const FALLOFF_PRIOR: f64 = 1.0;
/// Steps of conjugate gradients at most, and the share of the residual at which they end.
const STEPS: usize = 400;
const ENOUGH: f64 = 1e-8;

/// One place in two pictures.
#[derive(Clone, Copy, Debug)]
pub struct Ratio {
    /// Indices of the pictures.
    pub pictures: [u32; 2],
    /// Squared tangents of the angles off their axes.
    pub t2: [f32; 2],
    /// Log of the first's value over the second's, red, green and blue.
    pub log: [f32; 3],
}

/// What the ratios agree on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Solved {
    /// Log gains by picture; their median is 0 in each channel. `None`: it shares no place with another.
    pub gains: Vec<Option<[f32; 3]>>,
    /// Coefficients of t², t⁴ and t⁶.
    pub falloff: [f32; FALLOFF_TERMS],
    /// The largest t² of any ratio.
    pub reach: f32,
    /// Median difference between the pictures' colours of a place, natural logarithm.
    pub before: f32,
    /// Median difference after gains and fall-off are taken out.
    pub after: f32,
}

/// Weighted sums over the ratios of an overlap, for each channel.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    weight: f64,
    shape: [f64; FALLOFF_TERMS],
    log: f64,
}

#[derive(Clone, Debug)]
struct Overlap {
    pictures: [usize; 2],
    sums: [Sums; 3],
}

/// The whole of a weighted least-squares problem: one unknown per picture and channel, and the fall-off's terms behind them.
struct Normal {
    pictures: usize,
    overlaps: Vec<Overlap>,
    shape: [[f64; FALLOFF_TERMS]; FALLOFF_TERMS],
    shape_log: [f64; FALLOFF_TERMS],
}

/// Terms of the fall-off at the first place less those at the second, in units of the reach.
fn shape(ratio: &Ratio, reach: f32) -> [f64; FALLOFF_TERMS] {
    let [a, b] = ratio.t2.map(|t| f64::from(t / reach));
    std::array::from_fn(|k| a.powi(k as i32 + 1) - b.powi(k as i32 + 1))
}

/// Solves `ratios` between `pictures` pictures; `ratios` are sorted by their pictures here.
pub fn solve(pictures: usize, ratios: &mut [Ratio]) -> Solved {
    ratios.sort_by_key(|r| r.pictures);
    let reach = ratios.iter().flat_map(|r| r.t2).fold(0.0, f32::max);
    let mut solved = Solved { gains: vec![None; pictures], reach, ..Solved::default() };
    if ratios.is_empty() {
        return solved;
    }
    // Without a lens (colours of models) there is no fall-off.
    let reach = if reach > 0.0 { reach } else { 1.0 };
    let mut x = vec![0.0; 3 * pictures + FALLOFF_TERMS];
    let mut residuals = vec![0.0f32; 3 * ratios.len()];
    let mut left = |x: &[f64]| {
        for (ratio, out) in ratios.iter().zip(residuals.chunks_exact_mut(3)) {
            let bend: f64 = shape(ratio, reach).iter().zip(&x[3 * pictures..]).map(|(s, v)| s * v).sum();
            let [a, b] = ratio.pictures.map(|p| 3 * p as usize);
            for c in 0..3 {
                out[c] = (f64::from(ratio.log[c]) - bend - x[a + c] + x[b + c]) as f32;
            }
        }
        let mut sizes: Vec<f32> = residuals.iter().map(|r| r.abs()).collect();
        let middle = sizes.len() / 2;
        (*sizes.select_nth_unstable_by(middle, f32::total_cmp).1, residuals.clone())
    };
    let (mut median, mut residual) = left(&x);
    solved.before = median;
    for round in 0..ROUNDS {
        // All of them at first: gains may be larger than anything that textures do.
        let scale = if round == 0 { f64::INFINITY } else { OUTLIER * f64::from(median).max(1e-4) };
        let weight = |i: usize, c: usize| 1.0 / (1.0 + (f64::from(residual[3 * i + c]) / scale).powi(2));
        Normal::of(pictures, ratios, reach, weight).solve(&mut x);
        (median, residual) = left(&x);
    }
    solved.after = median;
    let mut seen = vec![false; pictures];
    ratios.iter().flat_map(|r| r.pictures).for_each(|p| seen[p as usize] = true);
    for c in 0..3 {
        let mut known: Vec<f64> = (0..pictures).filter(|p| seen[*p]).map(|p| x[3 * p + c]).collect();
        let middle = known.len() / 2;
        let usual = *known.select_nth_unstable_by(middle, f64::total_cmp).1;
        for p in (0..pictures).filter(|p| seen[*p]) {
            solved.gains[p].get_or_insert_default()[c] = (x[3 * p + c] - usual) as f32;
        }
    }
    let terms = &x[3 * pictures..];
    solved.falloff = std::array::from_fn(|k| (terms[k] / f64::from(reach).powi(k as i32 + 1)) as f32);
    solved
}

impl Normal {
    fn of(pictures: usize, ratios: &[Ratio], reach: f32, weight: impl Fn(usize, usize) -> f64) -> Self {
        let (mut shape_sum, mut shape_log) = ([[0.0; FALLOFF_TERMS]; FALLOFF_TERMS], [0.0; FALLOFF_TERMS]);
        let mut overlaps: Vec<Overlap> = Vec::new();
        for (i, ratio) in ratios.iter().enumerate() {
            let pair = ratio.pictures.map(|p| p as usize);
            if overlaps.last().is_none_or(|o| o.pictures != pair) {
                overlaps.push(Overlap { pictures: pair, sums: [Sums::default(); 3] });
            }
            let Some(overlap) = overlaps.last_mut() else { continue };
            let terms = shape(ratio, reach);
            for c in 0..3 {
                let (w, log) = (weight(i, c), f64::from(ratio.log[c]));
                let sums = &mut overlap.sums[c];
                sums.weight += w;
                sums.log += w * log;
                for k in 0..FALLOFF_TERMS {
                    sums.shape[k] += w * terms[k];
                    shape_log[k] += w * terms[k] * log;
                    (0..FALLOFF_TERMS).for_each(|l| shape_sum[k][l] += w * terms[k] * terms[l]);
                }
            }
        }
        Self { pictures, overlaps, shape: shape_sum, shape_log }
    }

    /// The matrix times `x`.
    fn times(&self, x: &[f64], out: &mut [f64]) {
        let (gains, terms) = x.split_at(3 * self.pictures);
        let (out_gains, out_terms) = out.split_at_mut(3 * self.pictures);
        out_gains.iter_mut().zip(gains).for_each(|(o, g)| *o = GAIN_PRIOR * g);
        for k in 0..FALLOFF_TERMS {
            out_terms[k] =
                FALLOFF_PRIOR * terms[k] + (0..FALLOFF_TERMS).map(|l| self.shape[k][l] * terms[l]).sum::<f64>();
        }
        for overlap in &self.overlaps {
            let [a, b] = overlap.pictures.map(|p| 3 * p);
            for (c, sums) in overlap.sums.iter().enumerate() {
                let apart = gains[a + c] - gains[b + c];
                let pull = sums.weight * apart + (0..FALLOFF_TERMS).map(|k| sums.shape[k] * terms[k]).sum::<f64>();
                out_gains[a + c] += pull;
                out_gains[b + c] -= pull;
                (0..FALLOFF_TERMS).for_each(|k| out_terms[k] += sums.shape[k] * apart);
            }
        }
    }

    /// Conjugate gradients from `x` on, each unknown in units of its own diagonal.
    fn solve(&self, x: &mut [f64]) {
        let n = x.len();
        let (mut diagonal, mut rest) = (vec![GAIN_PRIOR; n], vec![0.0; n]);
        for k in 0..FALLOFF_TERMS {
            diagonal[3 * self.pictures + k] = FALLOFF_PRIOR + self.shape[k][k];
            rest[3 * self.pictures + k] = self.shape_log[k];
        }
        for overlap in &self.overlaps {
            let [a, b] = overlap.pictures.map(|p| 3 * p);
            for (c, sums) in overlap.sums.iter().enumerate() {
                diagonal[a + c] += sums.weight;
                diagonal[b + c] += sums.weight;
                rest[a + c] += sums.log;
                rest[b + c] -= sums.log;
            }
        }
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let mut product = vec![0.0; n];
        self.times(x, &mut product);
        rest.iter_mut().zip(&product).for_each(|(r, p)| *r -= p);
        let scaled = |r: &[f64]| -> Vec<f64> { r.iter().zip(&diagonal).map(|(r, d)| r / d).collect() };
        let mut z = scaled(&rest);
        let mut direction = z.clone();
        let mut size = dot(&rest, &z);
        let end = ENOUGH * ENOUGH * size;
        for _ in 0..STEPS {
            self.times(&direction, &mut product);
            let curvature = dot(&direction, &product);
            if size <= end || curvature <= 0.0 {
                break;
            }
            let step = size / curvature;
            x.iter_mut().zip(&direction).for_each(|(x, d)| *x += step * d);
            rest.iter_mut().zip(&product).for_each(|(r, p)| *r -= step * p);
            z = scaled(&rest);
            let next = dot(&rest, &z);
            let turn = next / size;
            direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + turn * *d);
            size = next;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: usize) -> f32 {
        let hash = (i as u32).wrapping_mul(2_654_435_761);
        ((hash ^ (hash >> 15)).wrapping_mul(2_246_822_519) >> 8) as f32 / (1u32 << 24) as f32 - 0.5
    }

    fn gain(picture: u32, channel: usize) -> f32 {
        // Up to 40 %, and another white in each.
        0.7 * noise(picture as usize + 50) + 0.2 * noise(1000 + 3 * picture as usize + channel)
    }

    fn falloff(t2: f32) -> f32 {
        -2.0 * (1.0 + t2).ln()
    }

    /// A row of pictures, each beside the next three, with noise of 5 % and a fifth of places that are something else.
    fn row(pictures: u32) -> Vec<Ratio> {
        let mut ratios = Vec::new();
        for a in 0..pictures {
            for b in (a + 1)..(a + 4).min(pictures) {
                for i in 0..40usize {
                    let at = ratios.len();
                    let t2 = [0.25 + 0.5 * noise(7 * at + i), 0.25 + 0.5 * noise(7 * at + i + 3)];
                    let stray = if i % 5 == 0 { 3.0 * noise(11 * at) } else { 0.0 };
                    let log = [0, 1, 2].map(|c| {
                        gain(a, c) - gain(b, c) + falloff(t2[0]) - falloff(t2[1]) + 0.1 * noise(13 * at + c) + stray
                    });
                    ratios.push(Ratio { pictures: [a, b], t2, log });
                }
            }
        }
        ratios
    }

    #[test]
    fn gains_and_fall_off_are_found_among_noise_and_strays() {
        let solved = solve(61, &mut row(60));
        assert!(solved.gains[60].is_none(), "it shares nothing with another");
        assert!(solved.after < 0.06 && solved.before > 3.0 * solved.after, "{} {}", solved.before, solved.after);
        for c in 0..3 {
            let off: Vec<f32> = (0..60).map(|p| solved.gains[p as usize].unwrap()[c] - gain(p, c)).collect();
            let mean = off.iter().sum::<f32>() / 60.0;
            let worst = off.iter().map(|o| (o - mean).abs()).fold(0.0, f32::max);
            assert!(worst < 0.06, "channel {c}: {worst}");
        }
        for i in 1..=10 {
            let t2 = 0.05 * i as f32;
            let found: f32 = (0..3).map(|k| solved.falloff[k] * t2.powi(k as i32 + 1)).sum();
            assert!((found - falloff(t2)).abs() < 0.02, "at {t2}: {found} {}", falloff(t2));
        }
    }

    #[test]
    fn pictures_in_one_light_are_left_in_it() {
        let mut ratios = row(30);
        ratios.iter_mut().enumerate().for_each(|(i, r)| r.log = [0, 1, 2].map(|c| 0.1 * noise(17 * i + c)));
        let solved = solve(30, &mut ratios);
        let most = solved.gains.iter().flatten().flatten().fold(0.0f32, |a, g| a.max(g.abs()));
        assert!(most < 0.02 && solved.falloff.iter().all(|c| c.abs() < 0.1), "{most} {:?}", solved.falloff);
        assert!(solved.after > 0.9 * solved.before);
        assert_eq!(solve(3, &mut []).gains, vec![None; 3]);
    }
}
