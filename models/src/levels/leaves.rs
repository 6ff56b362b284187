//! Squares of ground with about as many Gaussians each: what a viewer loads, at the level of detail that its distance asks for.

use std::borrow::Cow;

/// Power of two of the finest squares along a side: 4 M counts of four bytes.
const FINEST: u32 = 11;
/// Squares along a side.
const SIDE: usize = 1 << FINEST;
/// Gaussians of a leaf at most, unless a finest square holds more: what is read at once.
const LEAF: u32 = 32_768;
/// Gaussians of a square that say how dense they lie.
const ENOUGH: u32 = 16;
/// What lies so many times farther from the middle than 98 % of all is left out: strays of a training, far beyond any horizon.
const STRAY: f32 = 20.0;
/// Share of the sample at either end that does not count for the extent.
const TAIL: f64 = 0.01;

/// A square around most of a scene, in squares of which the Gaussians are counted.
pub(super) struct Ground {
    middle: [f32; 2],
    half: f32,
}

impl Ground {
    /// From the means of some of the Gaussians; `None` without any.
    pub fn around(sample: &mut [[f32; 3]]) -> Option<Self> {
        if sample.is_empty() {
            return None;
        }
        let mut middle = [0.0; 2];
        let mut half = f32::MIN_POSITIVE;
        for k in 0..2 {
            sample.sort_unstable_by(|a, b| a[k].total_cmp(&b[k]));
            let at = |share: f64| sample[((sample.len() - 1) as f64 * share).round() as usize][k];
            let (from, to) = (at(TAIL), at(1.0 - TAIL));
            middle[k] = from + 0.5 * (to - from);
            // Twice as wide as most of it: what is farther out shares the squares at the rim.
            half = half.max(to - from);
        }
        Some(Self { middle, half })
    }

    /// The finest square under a mean; `None` for a stray.
    fn square(&self, mean: [f32; 3]) -> Option<(usize, usize)> {
        let offset = [0, 1].map(|k| mean[k] - self.middle[k]);
        if offset.iter().any(|d| d.abs() > STRAY * self.half) {
            return None;
        }
        let index = |d: f32| (((d / self.half + 1.0) * 0.5 * SIDE as f32) as usize).min(SIDE - 1);
        Some((index(offset[0]), index(offset[1])))
    }

    /// Metres of a finest square.
    fn square_m(&self) -> f32 {
        2.0 * self.half / SIDE as f32
    }
}

/// Gaussians of each finest square.
pub(super) struct Counts {
    ground: Ground,
    counts: Vec<u32>,
    /// Left out: too far away.
    pub strays: u64,
}

impl Counts {
    pub fn new(ground: Ground) -> Self {
        Self { ground, counts: vec![0; SIDE * SIDE], strays: 0 }
    }

    pub fn add(&mut self, mean: [f32; 3]) {
        match self.ground.square(mean) {
            Some((x, y)) => self.counts[y * SIDE + x] += 1,
            None => self.strays += 1,
        }
    }

    /// The usual distance between neighbours, metres: the median over all Gaussians of the side of a square of ground that holds one of them.
    pub fn spacing_m(&self) -> f64 {
        let mut side_m = f64::from(self.ground.square_m());
        let mut counts = Cow::Borrowed(&self.counts);
        for level in 1..=FINEST {
            if median_of_gaussians(&counts) >= ENOUGH {
                break;
            }
            counts = Cow::Owned(coarser(&counts, SIDE >> level));
            side_m *= 2.0;
        }
        side_m / f64::from(median_of_gaussians(&counts).max(1)).sqrt()
    }

    /// The leaves, in an order in which neighbours are near each other.
    pub fn leaves(self) -> Leaves {
        let mut leaves = Leaves { ground: self.ground, leaf_of: vec![0; SIDE * SIDE], counts: Vec::new() };
        // Counts of ever coarser squares, four to one.
        let mut levels = vec![self.counts];
        for level in 1..=FINEST {
            levels.push(coarser(&levels[level as usize - 1], SIDE >> level));
        }
        leaves.divide(&levels, FINEST, 0, 0);
        leaves
    }
}

/// The counts of `side` times `side` squares out of those of squares half as wide.
fn coarser(finer: &[u32], side: usize) -> Vec<u32> {
    let four =
        |x: usize, y: usize| [0, 1, 2 * side, 2 * side + 1].iter().map(|o| finer[4 * y * side + 2 * x + o]).sum();
    (0..side * side).map(|i| four(i % side, i / side)).collect()
}

/// How many share the square of the median Gaussian.
fn median_of_gaussians(counts: &[u32]) -> u32 {
    let mut full: Vec<u32> = counts.iter().copied().filter(|n| *n > 0).collect();
    full.sort_unstable();
    let half = full.iter().map(|n| u64::from(*n)).sum::<u64>().div_ceil(2);
    let mut before = 0;
    let reaches_half = |n: &&u32| {
        before += u64::from(**n);
        before >= half
    };
    full.iter().find(reaches_half).copied().unwrap_or(0)
}

/// Which leaf each finest square belongs to.
pub(super) struct Leaves {
    ground: Ground,
    leaf_of: Vec<u32>,
    /// Gaussians of each leaf.
    pub counts: Vec<u32>,
}

impl Leaves {
    fn divide(&mut self, levels: &[Vec<u32>], level: u32, x: usize, y: usize) {
        let side = SIDE >> level;
        let n = levels[level as usize][y * side + x];
        if n == 0 {
            return;
        }
        if n > LEAF && level > 0 {
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                self.divide(levels, level - 1, 2 * x + dx, 2 * y + dy);
            }
            return;
        }
        let wide = 1 << level;
        for row in y * wide..(y + 1) * wide {
            self.leaf_of[row * SIDE + x * wide..][..wide].fill(self.counts.len() as u32);
        }
        self.counts.push(n);
    }

    /// The leaf under a mean; `None` for a stray.
    pub fn of(&self, mean: [f32; 3]) -> Option<usize> {
        self.ground.square(mean).map(|(x, y)| self.leaf_of[y * SIDE + x] as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 200 x 200 means a metre apart, as many on a tenth of the ground, and one beyond the moon.
    fn means() -> Vec<[f32; 3]> {
        let field = (0..200 * 200).map(|i| [(i % 200) as f32, (i / 200) as f32, 1.0]);
        let town = (0..200 * 200).map(|i| [50.0 + 0.1 * (i % 200) as f32, 20.0 + 0.1 * (i / 200) as f32, 5.0]);
        field.chain(town).chain([[4e8, 0.0, 0.0]]).collect()
    }

    fn counted(means: &[[f32; 3]]) -> Counts {
        let mut sample: Vec<_> = means.iter().step_by(7).copied().collect();
        let mut counts = Counts::new(Ground::around(&mut sample).expect("a sample"));
        means.iter().for_each(|m| counts.add(*m));
        counts
    }

    #[test]
    fn every_gaussian_but_strays_lies_in_one_leaf_and_no_leaf_holds_too_many() {
        let means = means();
        let counts = counted(&means);
        assert_eq!(counts.strays, 1);
        let leaves = counts.leaves();
        let mut found = vec![0; leaves.counts.len()];
        means.iter().filter_map(|m| leaves.of(*m)).for_each(|leaf| found[leaf] += 1);
        assert_eq!(found, leaves.counts);
        assert_eq!(found.iter().sum::<u32>(), 80_000);
        assert!(found.len() > 2 && found.iter().all(|n| *n > 0 && *n <= LEAF), "{found:?}");
    }

    #[test]
    fn the_spacing_is_that_of_the_ground_where_most_gaussians_lie() {
        let field: Vec<[f32; 3]> =
            (0..300 * 300).map(|i| [0.5 * (i % 300) as f32, 0.5 * (i / 300) as f32, 0.0]).collect();
        let spacing = counted(&field).spacing_m();
        assert!((0.25..0.75).contains(&spacing), "{spacing} m instead of 0.5 m");
    }

    #[test]
    fn a_scene_at_one_point_and_none_at_all_have_an_answer() {
        assert!(Ground::around(&mut []).is_none());
        let counts = counted(&[[3.0, 4.0, 5.0]; 10]);
        assert!(counts.spacing_m() > 0.0);
        assert_eq!(counts.leaves().counts, [10]);
    }
}
