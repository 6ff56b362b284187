//! Which view comes next: each once per epoch in a seeded shuffle, plus extra visits to those with the largest loss.

use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

pub(crate) struct Sampler {
    seed: u64,
    rng: Pcg64Mcg,
    order: Vec<u32>,
    by_loss: Vec<u32>,
}

impl Sampler {
    pub fn new(seed: u64, capacity: usize) -> Self {
        let order = Vec::with_capacity(2 * capacity + 1);
        Self { seed, rng: Pcg64Mcg::seed_from_u64(seed), order, by_loss: Vec::with_capacity(capacity) }
    }

    /// Back to the first epoch.
    pub fn reset(&mut self) {
        self.rng = Pcg64Mcg::seed_from_u64(self.seed);
        self.order.clear();
    }

    /// The set of views changed: the present epoch ends.
    pub fn forget(&mut self) {
        self.order.clear();
    }

    /// A generator for what else needs chance (density control).
    pub fn rng(&mut self) -> &mut Pcg64Mcg {
        &mut self.rng
    }

    /// The view that [`Self::next`] will give, when its epoch has begun.
    pub fn peek(&self) -> Option<usize> {
        self.order.last().map(|v| *v as usize)
    }

    /// `losses(view)` is the view's last loss; `views` is at least 1.
    pub fn next(&mut self, views: usize, residual_share: f32, losses: impl Fn(usize) -> f32) -> usize {
        if self.order.is_empty() {
            self.order.extend(0..views as u32);
            let extra = (views as f32 * residual_share) as usize;
            if extra > 0 {
                self.by_loss.clear();
                self.by_loss.extend(0..views as u32);
                self.by_loss
                    .sort_unstable_by(|a, b| losses(*b as usize).total_cmp(&losses(*a as usize)).then(a.cmp(b)));
                self.order.extend(self.by_loss.iter().take(extra.min(views)));
            }
            // Fisher–Yates.
            for i in (1..self.order.len()).rev() {
                let j = self.rng.random_range(0..=i);
                self.order.swap(i, j);
            }
        }
        self.order.pop().map_or(0, |v| v as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Visits to each of `views` in one epoch with half as many extra visits.
    fn visits(views: usize, loss: impl Fn(usize) -> f32 + Copy) -> Vec<usize> {
        let mut sampler = Sampler::new(7, views);
        let mut visits = vec![0; views];
        (0..views + views / 2).for_each(|_| visits[sampler.next(views, 0.5, loss)] += 1);
        visits
    }

    #[test]
    fn views_of_equal_or_unknown_loss_are_ranked_never_divided() {
        // (L - min) / (max - min) would be 0/0: the extra visits go to the first views, each of which is there once anyway.
        for loss in [0.0, 0.25, f32::INFINITY, f32::NAN] {
            assert_eq!(visits(4, |_| loss), [2, 2, 1, 1], "{loss}");
        }
        assert_eq!(visits(1, |_| 0.0), [1]);
    }

    #[test]
    fn extra_visits_go_to_the_largest_losses() {
        assert_eq!(visits(4, |v| [0.1, 0.4, 0.2, 0.3][v]), [1, 2, 1, 2]);
    }
}
