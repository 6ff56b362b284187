//! Density control under the hard cap, on the host between two steps: dead Gaussians move onto live ones and free places
//! are filled by splitting, both with the opacity and scale that leave the picture unchanged (3DGS-MCMC, Kheradmand et
//! al. 2024, eq. 9) where they lie close together; or dead ones are only removed. Copied is what is opaque, as there, and what the loss
//! hangs on: more of it goes where pictures are not yet right.

use super::parameters::Geometry;
use super::{TrainError, Trainer};
use crate::layout::DEFERRED_STEPS;
use config::training::Strategy;
use glam::{Quat, Vec3};
use rand::Rng;

/// Copies of one Gaussian that the formula is tabulated for (as the reference implementation's `N_max`).
const MOST_COPIES: usize = 51;
/// Opacities are kept inside this before the formula: at 1 every copy would be opaque, at 0 none visible.
const OPACITY_RANGE: (f64, f64) = (1e-6, 1.0 - 1e-6);

/// Lists that density control works in, allocated once.
pub(crate) struct Scratch {
    dead: Vec<u32>,
    /// Running sum of what the live Gaussians are [worth](worth).
    cumulative: Vec<f64>,
    /// How many copies of each Gaussian are wanted besides itself.
    copies: Vec<u32>,
    /// Gaussians to copy and where to.
    moves: Vec<[u32; 2]>,
    binomials: Vec<[f64; MOST_COPIES]>,
    /// Pictures looked at when it was last done.
    pub last: f64,
    pub last_flush: u32,
}

impl Scratch {
    pub fn new(capacity: usize) -> Self {
        let mut binomials = vec![[0.0; MOST_COPIES]; MOST_COPIES];
        for n in 0..MOST_COPIES {
            for k in 0..=n {
                binomials[n][k] = if k == 0 { 1.0 } else { binomials[n][k - 1] * (n + 1 - k) as f64 / k as f64 };
            }
        }
        Self {
            dead: Vec::with_capacity(capacity),
            cumulative: Vec::with_capacity(capacity),
            copies: vec![0; capacity],
            moves: Vec::with_capacity(capacity),
            binomials,
            last: 0.0,
            last_flush: 0,
        }
    }

    /// Opacity and scale factor of each of `n` equal Gaussians that together look like one of `opacity`.
    fn split(&self, opacity: f64, n: usize) -> (f64, f64) {
        let n = n.clamp(1, MOST_COPIES);
        let opacity = opacity.clamp(OPACITY_RANGE.0, OPACITY_RANGE.1);
        let each = 1.0 - (1.0 - opacity).powf(1.0 / n as f64);
        let mut sum = 0.0;
        for i in 0..n {
            for k in 0..=i {
                let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
                sum += self.binomials[i][k] * sign * each.powi(k as i32 + 1) / ((k + 1) as f64).sqrt();
            }
        }
        (each, opacity / sum)
    }
}

/// Steps after which the lazy Adam updates of Gaussians outside the view are done. The result would be the same without, but not to
/// the bit: a snapshot taken in between decides the rounding. So it is done at fixed steps, and who wants identical
/// bytes takes snapshots there ([`StepReport::settled`](super::StepReport::settled)).
const FLUSH_EVERY: u32 = 32;
const _: () = assert!((FLUSH_EVERY as usize) < DEFERRED_STEPS);

fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

fn logit(opacity: f64) -> f32 {
    let o = opacity.clamp(OPACITY_RANGE.0, OPACITY_RANGE.1);
    (o / (1.0 - o)).ln() as f32
}

/// In proportion to this a Gaussian is copied: its opacity (3DGS-MCMC) times the root of its sensitivity. +0.5 dB on fox after 1,000 steps
/// (tests/results/TRIED.md).
fn worth(g: &Geometry, opacity: f64) -> f64 {
    // Where no gradient ever was, opacity alone decides.
    opacity * f64::from(g.sensitivity(1.0)).max(f64::MIN_POSITIVE).sqrt()
}

impl Trainer {
    /// Runs density control when its time has come.
    pub(super) fn control_density(&mut self, progress: f32) -> Result<(), TrainError> {
        let _phase = tracing::trace_span!("density control").entered();
        let since_flush = self.updates - self.density.last_flush;
        let d = self.settings.density;
        let interval = d.interval(self.expected_steps());
        let since = (self.looked - self.density.last) as f32;
        let paged = self.scene.is_paged();
        let share = if paged { self.density_due(since, interval) } else { since / interval.max(1) as f32 };
        let due = share >= 1.0 && (!paged || self.window_ends());
        if self.strategy == Strategy::None || progress >= d.until || !due {
            if since_flush >= FLUSH_EVERY {
                self.flush()?;
                self.density.last_flush = self.updates;
            }
            return Ok(());
        }
        self.flush()?;
        self.density.last_flush = self.updates;
        self.density.last = self.looked;
        self.decay_opacities(progress);
        self.drop_non_finite();
        match self.strategy {
            Strategy::Prune => self.prune(),
            _ => self.relocate_and_grow()?,
        }
        Ok(())
    }

    fn decay_opacities(&mut self, progress: f32) {
        let amount = f64::from(self.settings.regularise.opacity_decay * (1.0 - progress));
        if amount <= 0.0 {
            return;
        }
        for g in &mut self.parameters.geometry_mut(&mut self.arena)[..self.gaussians] {
            g.opacity_logit = logit(opacity(g.opacity_logit) - amount);
        }
    }

    /// Gaussians that went bad in spite of everything leave.
    fn drop_non_finite(&mut self) {
        self.remove_where(|g| !g.is_finite());
    }

    fn prune(&mut self) {
        let limit = f64::from(self.settings.density.dead_opacity);
        self.remove_where(|g| opacity(g.opacity_logit) < limit);
    }

    /// Removes Gaussians, but never the last one; the last ones take the places of those removed.
    fn remove_where(&mut self, leaves: impl Fn(&Geometry) -> bool) {
        let mut index = 0;
        while index < self.gaussians && self.gaussians > 1 {
            if !leaves(&self.parameters.geometry(&self.arena)[index]) {
                index += 1;
                continue;
            }
            self.gaussians -= 1;
            if index != self.gaussians {
                self.parameters.shift(&mut self.arena, self.gaussians, index);
                self.scene.place(self.gaussians, index);
            }
            self.counters.pruned += 1;
        }
        self.scene.truncate(self.gaussians);
    }

    fn relocate_and_grow(&mut self) -> Result<(), TrainError> {
        let n = self.gaussians;
        let grown = (n as f32 * self.settings.density.growth) as usize;
        if self.plan.is_paged() && !self.scene.is_paged() && n + grown > self.plan.gaussians {
            return self.enter_cells();
        }
        let limit = f64::from(self.settings.density.dead_opacity);
        let free = grown.min(self.plan.gaussians - n).min(self.plan.scene - self.gaussians());
        let s = &mut self.density;
        s.dead.clear();
        s.cumulative.clear();
        s.moves.clear();
        let mut sum = 0.0;
        for (i, g) in self.parameters.geometry(&self.arena)[..n].iter().enumerate() {
            let o = opacity(g.opacity_logit);
            if o < limit {
                s.dead.push(i as u32);
            } else {
                sum += worth(g, o);
            }
            s.cumulative.push(sum);
        }
        // All dead: nothing worth copying; training or pruning must go on from what there is.
        if sum <= 0.0 {
            return Ok(());
        }
        s.copies[..n].fill(0);
        let rng = self.sampler.rng();
        let (dead, room) = (s.dead.len(), s.dead.len() + free);
        for k in 0..room {
            let at: f64 = rng.random_range(0.0..sum);
            let source = s.cumulative.partition_point(|c| *c <= at).min(n - 1);
            if s.copies[source] + 1 >= MOST_COPIES as u32 {
                continue;
            }
            s.copies[source] += 1;
            let to = if k < dead { s.dead[k] } else { u32::MAX };
            s.moves.push([source as u32, to]);
        }
        self.apply_copies(n);
        Ok(())
    }

    fn apply_copies(&mut self, n: usize) {
        let parameters = self.parameters;
        for (g, copies) in parameters.geometry_mut(&mut self.arena)[..n].iter_mut().zip(&self.density.copies) {
            if *copies > 0 {
                let (each, factor) = self.density.split(opacity(g.opacity_logit), *copies as usize + 1);
                g.opacity_logit = logit(each.max(f64::from(self.settings.density.dead_opacity)));
                g.log_scale = g.log_scale.map(|s| s + factor.ln() as f32);
            }
        }
        for i in 0..self.density.moves.len() {
            let [from, to] = self.density.moves[i].map(|v| v as usize);
            let to = if to == u32::MAX as usize {
                self.gaussians += 1;
                self.counters.added += 1;
                self.gaussians - 1
            } else {
                self.counters.relocated += 1;
                to
            };
            parameters.copy(&mut self.arena, from, to);
            self.scene.place(from, to);
            self.displace(to);
        }
    }

    /// Moves a copy to a place drawn from the Gaussian it was copied from.
    fn displace(&mut self, index: usize) {
        let spread = self.settings.density.spread;
        if spread <= 0.0 {
            return;
        }
        let g = &mut self.parameters.geometry_mut(&mut self.arena)[index];
        let [w, x, y, z] = g.rotation;
        let rotation = Quat::from_xyzw(x, y, z, w).normalize();
        let rng = self.sampler.rng();
        // A Gaussian larger than the scene (log scales may be 40) sends no copy out of it.
        let extent = self.extent;
        let along = g.log_scale.map(|s| s.exp().min(extent) * normal(rng) * spread);
        let offset = rotation * Vec3::from(along);
        // A zero quaternion has no direction: the copy then stays where its source is.
        if offset.is_finite() {
            for (mean, offset) in g.mean.iter_mut().zip(offset.to_array()) {
                *mean += offset;
            }
        }
    }
}

/// A number of mean 0 and variance 1, at most 6 from 0 (Irwin and Hall): the same bits on every platform, as no
/// library's logarithm takes part.
fn normal(rng: &mut impl Rng) -> f32 {
    (0..12).map(|_| rng.random_range(0.0..1.0f32)).sum::<f32>() - 6.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_as_opaque_the_one_that_the_loss_hangs_on_is_worth_more() {
        let mut g: Geometry = bytemuck::Zeroable::zeroed();
        g.opacity_logit = 1.0;
        let untold = worth(&g, 0.7);
        assert!(untold > 0.0, "before any gradient");
        g.second[0][3] = 1e-8;
        let little = worth(&g, 0.7);
        g.second[0][3] = 16.0 * 1e-8;
        assert!((worth(&g, 0.7) / little - 2.0).abs() < 1e-6);
        assert!((worth(&g, 0.35) / little - 1.0).abs() < 1e-6);
        g.opacity_logit = 80.0;
        assert!(worth(&g, 1.0).is_finite(), "one that is opaque");
    }

    #[test]
    fn split_gaussians_together_are_as_opaque_as_the_one_they_replace() {
        let s = Scratch::new(1);
        for o in [0.01, 0.3, 0.9, 0.999] {
            for n in [1, 2, 5, 51] {
                let (each, factor) = s.split(o, n);
                assert!((1.0 - (1.0 - each).powi(n as i32) - o).abs() < 1e-9);
                assert!(factor.is_finite() && factor > 0.0 && factor <= 1.0 + 1e-6, "{o} {n} {factor}");
            }
        }
    }

    #[test]
    fn an_opacity_of_one_splits_into_finite_ones() {
        let (each, factor) = Scratch::new(1).split(1.0, 3);
        assert!(each < 1.0 && factor.is_finite());
        assert!(logit(1.0).is_finite() && logit(-1.0).is_finite());
    }
}
