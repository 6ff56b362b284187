//! What the heights of a map are worth: their standard deviation, how far errors of neighbours agree, and what all have in common.

use glam::DVec2;

use crate::heights::Heights;

/// Lags at which a map's roughness is told, pixels.
const LAGS: [usize; 5] = [1, 2, 4, 8, 16];
/// Errors count as independent from the lag on whose differences have this share of the variance of those at the largest.
const SATURATED: f64 = 0.81;
/// Places sampled for each lag, evenly spread.
const SAMPLES: usize = 50_000;
/// Pixels that two maps are compared in, at the least.
const FEWEST: usize = 200;
/// Of a median of absolute values to a standard deviation, where errors are normal.
const NORMAL: f64 = 1.4826;
/// Variance of h(x) − (h(x−l) + h(x+l))/2 for one of independent heights.
const SECOND: f64 = 1.5;

/// What the heights of a map are worth.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Noise {
    /// Standard deviation of a height, metres.
    pub sigma_m: f64,
    /// Errors nearer to each other than this are one, metres.
    pub reach_m: f64,
    /// Standard deviation of what all heights are off by together, metres.
    pub bias_m: f64,
}

impl Noise {
    /// Tells noise from the map's own roughness: how far each height is off the mean of two on opposite sides of it, by the distance
    /// of those. On rough ground it is an upper bound. `None` where the map is too small, or nearly empty.
    ///
    /// Heights that are all alike say nothing of it: `None`, too.
    ///
    /// An error that bends the whole map is not in it: that is the bias's.
    pub fn of(heights: &Heights) -> Option<Self> {
        let step = step(heights)?;
        let variances: Vec<f64> = LAGS.iter().map_while(|lag| roughness(heights, *lag)).collect();
        let (last, before) = variances.split_last()?;
        let most = before.iter().fold(*last, |a, b| a.max(*b));
        let lag = LAGS.iter().zip(&variances).find(|(_, v)| **v >= SATURATED * most).map_or(LAGS[0], |(lag, _)| *lag);
        // Whole metres, or centimetres, are off by up to half of one, evenly.
        let rounded = step * step / 12.0;
        Some(Self { sigma_m: (most + rounded).sqrt(), reach_m: lag as f64 * heights.gsd(), bias_m: 0.0 })
    }

    /// Pixels whose errors are one.
    pub fn pixels(&self, heights: &Heights) -> f64 {
        (self.reach_m * self.reach_m / heights.pixel_m2()).max(1.0)
    }
}

/// What two maps of one ground are apart where nothing was dug or heaped up.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Apart {
    /// The first less the second: the middle of all differences, metres.
    pub offset_m: f64,
    /// Its standard deviation, metres.
    pub sigma_m: f64,
    /// Pixels that both maps have there.
    pub pixels: usize,
}

/// Compares two maps wherever `counts` says that a place did not change. `None` where too little of both is there.
pub fn apart(a: &Heights, b: &Heights, noise: [&Noise; 2], mut counts: impl FnMut(DVec2) -> bool) -> Option<Apart> {
    let [w, h] = a.size();
    let step = ((w * h) as f64 / SAMPLES as f64).sqrt().ceil().max(1.0) as usize;
    let mut off = Vec::with_capacity(2 * SAMPLES);
    for y in (0..h).step_by(step) {
        for x in (0..w).step_by(step) {
            let place = a.place(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            if counts(place) {
                off.extend(a.at(x, y).zip(b.height(place)).map(|(a, b)| a - b));
            }
        }
    }
    let pixels = off.len();
    if pixels < FEWEST {
        return None;
    }
    let offset_m = geometry::median(&mut off)?;
    off.iter_mut().for_each(|d| *d = (*d - offset_m).abs());
    let spread = NORMAL * geometry::median(&mut off)?;
    // Patches of independent errors in what was compared.
    let reach = noise.map(|n| n.reach_m).into_iter().fold(a.gsd(), f64::max) / (step as f64 * a.gsd());
    let patches = (pixels as f64 / (reach * reach).max(1.0)).max(1.0);
    Some(Apart { offset_m, sigma_m: spread / patches.sqrt(), pixels })
}

/// The least difference between neighbours that are not alike: what heights were rounded to. `None` where all are alike: nothing tells
/// what they are worth.
fn step(heights: &Heights) -> Option<f64> {
    let [w, h] = heights.size();
    let beside = |i: usize| heights.at(i % w, i / w).zip(heights.at(i % w + 1, i / w)).map(|(a, b)| (a - b).abs());
    (0..w * h).filter_map(beside).filter(|d| *d > 0.0).reduce(f64::min)
}

/// Variance of a height by second differences at a lag, robustly.
fn roughness(heights: &Heights, lag: usize) -> Option<f64> {
    let [w, h] = heights.size();
    if w.min(h) <= 2 * lag {
        return None;
    }
    let step = ((w * h) as f64 / SAMPLES as f64).sqrt().ceil().max(1.0) as usize;
    let mut off = Vec::with_capacity(2 * SAMPLES);
    for y in (0..h).step_by(step) {
        for x in (0..w).step_by(step) {
            let Some(z) = heights.at(x, y) else { continue };
            let mut add = |a: Option<f64>, b: Option<f64>| off.extend(a.zip(b).map(|(a, b)| z - 0.5 * (a + b)));
            if x >= lag {
                add(heights.at(x - lag, y), heights.at(x + lag, y));
            }
            if y >= lag {
                add(heights.at(x, y - lag), heights.at(x, y + lag));
            }
        }
    }
    if off.len() < 32 {
        return None;
    }
    let middle = geometry::median(&mut off)?;
    off.iter_mut().for_each(|d| *d = (*d - middle).abs());
    let spread = NORMAL * geometry::median(&mut off)?;
    Some(spread * spread / SECOND)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;
    use crate::heights::testing::rough;

    #[test]
    fn noise_is_told_with_its_reach_on_a_slope_and_where_pixels_are_missing() {
        for blur in [0, 1, 3] {
            let (sigma, gsd) = (0.05, 0.1);
            let values = rough([200, 150], blur, sigma, 7);
            let sloped = (0..200 * 150)
                .map(|i| if i % 13 == 0 { f32::NAN } else { values[i] + 0.3 * (i % 200) as f32 * gsd as f32 });
            let heights = Heights::new(DVec2::ZERO, gsd, [200, 150], sloped.collect()).unwrap();
            let noise = Noise::of(&heights).unwrap();
            assert!((noise.sigma_m / sigma - 1.0).abs() < 0.15, "{blur}: {noise:?}");
            let box_side = (2 * blur + 1) as f64 * gsd;
            assert!((0.6..=2.1).contains(&(noise.reach_m / box_side)), "{blur}: {noise:?}");
        }
        assert!(Noise::of(&Heights::new(DVec2::ZERO, 1.0, [2, 2], vec![0.0; 4]).unwrap()).is_none());
        assert!(Noise::of(&Heights::new(DVec2::ZERO, 1.0, [40, 40], vec![f32::NAN; 1600]).unwrap()).is_none());
    }

    #[test]
    fn heights_in_whole_metres_are_worth_no_more_than_their_rounding_and_level_ones_say_nothing() {
        let map =
            |of: &dyn Fn(usize) -> f32| Heights::new(DVec2::ZERO, 1.0, [60, 60], (0..3600).map(of).collect()).unwrap();
        let whole = Noise::of(&map(&|i| (0.07 * (i % 60) as f32).round())).unwrap();
        assert!((whole.sigma_m - 1.0 / 12f64.sqrt()).abs() < 0.1, "{whole:?}");
        assert_eq!(Noise::of(&map(&|_| 40.0)), None);
    }

    #[test]
    fn two_maps_are_apart_by_what_most_of_their_ground_says() {
        let noise = Noise { sigma_m: 0.05, reach_m: 0.5, bias_m: 0.0 };
        let map = |lift: f32, seed| {
            let values = rough([200, 200], 2, 0.05, seed);
            let heap = |i: usize| if i % 200 < 60 && lift > 0.0 { 3.0 } else { 0.0 };
            let values = (0..200 * 200).map(|i| values[i] + lift + heap(i)).collect();
            Heights::new(DVec2::ZERO, 0.1, [200, 200], values).unwrap()
        };
        let (mut inside, seeds) = (0, 40);
        for seed in 0..seeds {
            let (a, b) = (map(0.7, 2 * seed + 1), map(0.0, 2 * seed + 2));
            let found = apart(&a, &b, [&noise; 2], |p| p.x >= 6.0).unwrap();
            inside += u32::from((found.offset_m - 0.7).abs() <= 2.0 * found.sigma_m);
            assert!(found.sigma_m < 0.02, "{found:?}");
        }
        assert!(inside >= 36, "{inside} of {seeds}");
        assert_eq!(apart(&map(0.7, 1), &map(0.0, 2), [&noise; 2], |_| false), None);
    }
}
