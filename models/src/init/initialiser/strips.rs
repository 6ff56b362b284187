//! Strips of ground, side by side: what is merged at once where the whole would take too much memory.

use glam::DVec3;

use crate::init::merge::Sample;

/// Voxels up to which the whole ground is merged at once.
const MOST_VOXELS: usize = 600_000;

/// Voxels that are held at once to merge so many: all of them, or strips of them in two thirds of the memory and with more work.
pub(super) fn at_once(voxels: usize) -> usize {
    if voxels <= MOST_VOXELS { voxels.max(1) } else { MOST_VOXELS * 2 / 3 }
}

/// Strips across the longer axis of what the pictures look at, as many pictures in each.
#[derive(Debug)]
pub(super) struct Strips {
    axis: usize,
    /// Where each but the last ends, metres; outwards they have no end.
    ends: Vec<f32>,
    /// Samples in each, of all pictures.
    samples: Vec<usize>,
}

impl Strips {
    /// `count` of them over the points that the pictures look at.
    pub fn over(looked_at: &[DVec3], count: usize) -> Self {
        let (low, high) = looked_at
            .iter()
            .filter(|p| p.is_finite())
            .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)));
        let axis = usize::from(high.y - low.y > high.x - low.x);
        let mut along: Vec<f32> = looked_at.iter().map(|p| p[axis] as f32).filter(|v| v.is_finite()).collect();
        along.sort_unstable_by(f32::total_cmp);
        let mut ends: Vec<f32> = (1..count).filter_map(|k| along.get(k * along.len() / count).copied()).collect();
        ends.dedup();
        Self { axis, samples: vec![0; ends.len() + 1], ends }
    }

    /// How many.
    pub fn count(&self) -> usize {
        self.ends.len() + 1
    }

    /// The one that a sample lies in; the first for what is not finite.
    pub fn of(&self, sample: &Sample) -> usize {
        let at = sample.position[self.axis];
        self.ends.iter().take_while(|end| at >= **end).count()
    }

    /// How many of a picture's samples lie in each.
    pub fn found(&self, samples: &[Vec<Sample>]) -> Vec<usize> {
        let mut found = vec![0; self.count()];
        samples.iter().flatten().for_each(|sample| found[self.of(sample)] += 1);
        found
    }

    /// Adds a picture's samples to those of each strip.
    pub fn count_in(&mut self, found: &[usize]) {
        self.samples.iter_mut().zip(found).for_each(|(sum, n)| *sum += n);
    }

    /// Of `budget` Gaussians those for the `strip`, by its share of the samples; never none.
    pub fn share(&self, strip: usize, budget: usize) -> usize {
        let (own, all) = (self.samples[strip] as u128, self.samples.iter().map(|n| *n as u128).sum::<u128>());
        ((budget as u128 * own / all.max(1)) as usize).clamp(1, budget.max(1))
    }
}

#[cfg(test)]
mod tests {
    use glam::{Mat3, Vec3};

    use super::*;

    fn at(x: f32, y: f32) -> Sample {
        Sample {
            position: Vec3::new(x, y, 0.0),
            color: Vec3::ZERO,
            covariance: Mat3::IDENTITY,
            weight: 1.0,
            opacity: 1.0,
        }
    }

    #[test]
    fn every_sample_lies_in_one_strip_and_budgets_add_up() {
        let looked_at: Vec<DVec3> = (0..90).map(|i| DVec3::new(5.0, f64::from(i), 0.0)).collect();
        let mut strips = Strips::over(&looked_at, 3);
        let of = |y: f32| strips.of(&at(99.0, y));
        let got = [-1e9, 0.0, 29.5, 30.0, 59.9, 60.0, f32::INFINITY, f32::NAN].map(of);
        assert_eq!((strips.count(), got), (3, [0, 0, 0, 1, 1, 2, 2, 0]));
        strips.count_in(&[10, 30, 60]);
        assert_eq!([0, 1, 2].map(|k| strips.share(k, 1000)), [100, 300, 600]);
    }

    #[test]
    fn pictures_of_one_place_or_of_none_make_one_strip_or_narrow_ones_but_never_a_panic() {
        assert_eq!(Strips::over(&[], 4).count(), 1);
        assert_eq!(Strips::over(&[DVec3::NAN; 8], 4).count(), 1);
        let one = Strips::over(&[DVec3::ZERO; 8], 4);
        assert_eq!((one.count(), one.of(&at(-1.0, 0.0)), one.of(&at(0.0, 0.0))), (2, 0, 1));
        // No samples at all.
        assert_eq!(one.share(0, 100), 1);
    }
}
