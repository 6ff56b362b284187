//! Which view comes next: each once per epoch in a seeded shuffle, plus extra visits to those with the largest loss; or, while
//! views still come, the newest first.

use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Mean age of the views that are visited while new ones come, in views: from two lines of flight every view of the last line is
/// still visited.
const TAIL: u32 = 12;
/// Views drawn at once, so that the next one is known.
const DRAWN: usize = 4;

pub(crate) struct Sampler {
    /// Views when the last one was chosen.
    views: usize,
    newest: bool,
    /// Views drawn since the last new one.
    drawn: u32,
    seed: u64,
    rng: Pcg64Mcg,
    order: Vec<u32>,
    by_loss: Vec<u32>,
    /// How often each view was chosen.
    visits: Vec<u32>,
    /// While views came some were chosen more often than others: the next epoch begins with those chosen least.
    uneven: bool,
    /// Views that have no turn.
    left_out: Vec<bool>,
}

impl Sampler {
    pub fn new(seed: u64, capacity: usize) -> Self {
        let order = Vec::with_capacity(2 * capacity + 1);
        Self {
            views: 0,
            newest: false,
            drawn: 0,
            seed,
            rng: Pcg64Mcg::seed_from_u64(seed),
            order,
            by_loss: Vec::with_capacity(capacity),
            visits: vec![0; capacity],
            uneven: false,
            left_out: vec![false; capacity],
        }
    }

    /// Back to the first epoch.
    pub fn reset(&mut self) {
        self.rng = Pcg64Mcg::seed_from_u64(self.seed);
        self.leave_out(|_| false);
    }

    /// Views of which `is_left_out` says so have no turn from here on; the present epoch ends.
    pub fn leave_out(&mut self, is_left_out: impl Fn(usize) -> bool) {
        self.left_out.iter_mut().enumerate().for_each(|(view, left_out)| *left_out = is_left_out(view));
        self.order.clear();
    }

    /// Whether the newest views are visited first.
    pub fn prefers_newest(&self) -> bool {
        self.newest
    }

    /// The set of views changed: the present epoch ends.
    pub fn forget(&mut self) {
        self.order.clear();
        self.drawn = 0;
    }

    /// Newest first, or epochs.
    pub fn prefer_newest(&mut self, on: bool) {
        if std::mem::replace(&mut self.newest, on) != on {
            self.order.clear();
            self.uneven = !on;
        }
    }

    /// Views by age, each less likely than the next newer one by the same factor. The longer no new one comes, the longer the tail.
    fn draw_newest(&mut self, views: usize) {
        for _ in 0..DRAWN {
            let mean = TAIL + self.drawn / 2;
            let mut age = 0;
            while self.rng.random_range(0..mean) != 0 {
                age += 1;
            }
            self.order.push((views - 1 - age % views) as u32);
            self.drawn = self.drawn.saturating_add(1);
        }
        self.order.reverse();
    }

    /// A generator for what else needs chance (density control).
    pub fn rng(&mut self) -> &mut Pcg64Mcg {
        &mut self.rng
    }

    /// The view that [`Self::next`] will give, when its epoch has begun.
    pub fn peek(&self) -> Option<usize> {
        self.order.last().map(|v| *v as usize)
    }

    /// The next one while the newest are visited first.
    pub fn next_newest(&mut self, views: usize) -> Option<usize> {
        self.newest.then(|| self.next(views, 0.0, |_| 0.0))
    }

    /// `losses(view)` is the view's last loss; `views` is at least 1. Where they are others than before the present epoch ends.
    pub fn next(&mut self, views: usize, residual_share: f32, losses: impl Fn(usize) -> f32) -> usize {
        if std::mem::replace(&mut self.views, views) != views {
            self.forget();
        }
        if self.order.is_empty() && self.newest {
            self.draw_newest(views);
        }
        if self.order.is_empty() {
            let left_out = &self.left_out;
            let turns = || (0..views as u32).filter(|view| !left_out.get(*view as usize).is_some_and(|out| *out));
            self.order.extend(turns());
            let views = self.order.len();
            let extra = (views as f32 * residual_share) as usize;
            if extra > 0 {
                self.by_loss.clear();
                self.by_loss.extend(turns());
                self.by_loss
                    .sort_unstable_by(|a, b| losses(*b as usize).total_cmp(&losses(*a as usize)).then(a.cmp(b)));
                self.order.extend(self.by_loss.iter().take(extra.min(views)));
            }
            // Fisher–Yates.
            for i in (1..self.order.len()).rev() {
                let j = self.rng.random_range(0..=i);
                self.order.swap(i, j);
            }
            if std::mem::take(&mut self.uneven) {
                let visits = |view: &u32| self.visits.get(*view as usize).copied().unwrap_or(0);
                self.order.sort_by_key(|view| std::cmp::Reverse(visits(view)));
            }
        }
        let view = self.order.pop().map_or(0, |v| v as usize);
        self.visits.get_mut(view).into_iter().for_each(|visits| *visits = visits.saturating_add(1));
        view
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
    fn while_views_come_the_newest_are_visited_first_and_each_as_often_however_many_there_are() {
        // A view every eight steps.
        let flown = |views: usize| {
            let mut sampler = Sampler::new(3, views);
            sampler.prefer_newest(true);
            let mut visits = vec![0; views];
            for newest in 0..views {
                (0..8).for_each(|_| visits[sampler.next(newest + 1, 0.0, |_| 0.0)] += 1);
            }
            visits
        };
        let visits = flown(400);
        let mean = |part: &[usize]| part.iter().sum::<usize>() as f64 / part.len() as f64;
        let (early, late) = (mean(&visits[50..150]), mean(&visits[250..350]));
        assert!((early / late - 1.0).abs() < 0.1 && (late - 8.0).abs() < 1.0, "{early} {late}");
        // When nothing new comes every view has its turn.
        let mut sampler = Sampler::new(3, 100);
        sampler.prefer_newest(true);
        let mut seen = vec![0; 100];
        (0..2000).for_each(|_| seen[sampler.next(100, 0.0, |_| 0.0)] += 1);
        assert!(seen.iter().all(|n| *n > 0), "{seen:?}");
    }

    #[test]
    fn when_no_more_views_come_those_visited_least_have_the_first_turns() {
        let (views, mut sampler) = (100, Sampler::new(3, 100));
        sampler.prefer_newest(true);
        let mut before = vec![0; views];
        (0..400).for_each(|_| before[sampler.next(views, 0.0, |_| 0.0)] += 1);
        // As a load after the landing does it.
        sampler.prefer_newest(false);
        sampler.reset();
        let turns: Vec<i32> = (0..views).map(|_| before[sampler.next(views, 0.0, |_| 0.0)]).collect();
        assert!(turns.is_sorted() && turns[0] < turns[99], "{turns:?}");
        // From then on every epoch is shuffled.
        let next: Vec<i32> = (0..views).map(|_| before[sampler.next(views, 0.0, |_| 0.0)]).collect();
        assert!(!next.is_sorted());
    }

    #[test]
    fn views_that_are_left_out_have_no_turn_until_they_are_back() {
        let (views, mut sampler) = (10, Sampler::new(5, 10));
        let turns = |sampler: &mut Sampler, n| {
            let mut turns: Vec<usize> = (0..n).map(|_| sampler.next(views, 0.2, |v| v as f32)).collect();
            turns.sort_unstable();
            turns
        };
        sampler.next(views, 0.2, |_| 0.0);
        sampler.leave_out(|view| view % 5 == 4);
        assert_eq!(turns(&mut sampler, 9), [0, 1, 2, 3, 5, 6, 7, 8, 8], "none of them by its loss either");
        sampler.leave_out(|_| false);
        assert_eq!(turns(&mut sampler, 12), [0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 9, 9]);
    }

    #[test]
    fn extra_visits_go_to_the_largest_losses() {
        assert_eq!(visits(4, |v| [0.1, 0.4, 0.2, 0.3][v]), [1, 2, 1, 2]);
    }
}
