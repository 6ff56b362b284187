//! Density control under the hard cap, on the host between two steps: dead Gaussians move onto live ones and free places
//! are filled by splitting, both with the opacity and scale that leave the picture unchanged (3DGS-MCMC, Kheradmand et
//! al. 2024, eq. 9) where they lie close together; or dead ones are only removed. Copied is what is opaque, as there, and what the loss
//! hangs on: more of it goes where pictures are not yet right.

use super::Schedule;
use crate::device::Device;
use crate::error::TrainError;
use crate::layout::DEFERRED_STEPS;
use crate::model::{Geometry, Model};
use config::training::{Strategy as Chosen, TrainSettings};
use glam::{Quat, Vec3};
use rand::Rng;
use rand_pcg::Pcg64Mcg;

/// Copies of one Gaussian that the formula is tabulated for (as the reference implementation's `N_max`).
const MOST_COPIES: usize = 51;
/// Opacities are kept inside this before the formula: at 1 every copy would be opaque, at 0 none visible.
const OPACITY_RANGE: (f64, f64) = (1e-6, 1.0 - 1e-6);

/// Lists that density control works in, allocated once.
struct Scratch {
    dead: Vec<u32>,
    /// Running sum of what the live Gaussians are [worth](worth).
    cumulative: Vec<f64>,
    /// How many copies of each Gaussian are wanted besides itself.
    copies: Vec<u32>,
    /// Gaussians to copy and where to.
    moves: Vec<[u32; 2]>,
    binomials: Vec<[f64; MOST_COPIES]>,
}

impl Scratch {
    fn new(capacity: usize) -> Self {
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

/// What a densification changes, and by what.
struct Densified<'a> {
    device: &'a mut Device,
    model: &'a mut Model,
    settings: &'a TrainSettings,
    rng: &'a mut Pcg64Mcg,
}

/// How the number of Gaussians changes.
trait Strategy: Sync {
    /// Whether it changes at all.
    fn acts(&self) -> bool {
        true
    }

    /// Whether Gaussians may be added.
    fn grows(&self) -> bool {
        false
    }

    /// Changes it, between two steps.
    fn densify(&self, scratch: &mut Scratch, of: &mut Densified<'_>) -> Result<(), TrainError>;
}

/// Number and identity of the Gaussians stay.
struct Keep;

impl Strategy for Keep {
    fn acts(&self) -> bool {
        false
    }

    fn densify(&self, _: &mut Scratch, _: &mut Densified<'_>) -> Result<(), TrainError> {
        Ok(())
    }
}

/// Dead Gaussians are removed.
struct Prune;

impl Strategy for Prune {
    fn densify(&self, _: &mut Scratch, of: &mut Densified<'_>) -> Result<(), TrainError> {
        let limit = f64::from(of.settings.density.dead_opacity);
        of.model.remove_where(of.device, |g| opacity(g.opacity_logit) < limit);
        Ok(())
    }
}

/// Dead Gaussians move onto live ones, free places are filled by splitting.
struct Relocate;

impl Strategy for Relocate {
    fn grows(&self) -> bool {
        true
    }

    fn densify(&self, scratch: &mut Scratch, of: &mut Densified<'_>) -> Result<(), TrainError> {
        let (n, plan) = (of.model.gaussians, of.device.plan());
        let grown = (n as f32 * of.settings.density.growth) as usize;
        if plan.is_paged() && !of.model.scene.is_paged() && n + grown > plan.gaussians {
            return of.model.enter_cells(of.device, of.settings);
        }
        let free = grown.min(plan.gaussians - n).min(plan.scene - of.model.total());
        if scratch.choose(of, free) {
            scratch.apply(of);
        }
        Ok(())
    }
}

impl Scratch {
    /// Draws which Gaussians are copied, to the places of dead ones and to `free` more; false where all are dead: nothing is worth copying
    /// then, and training or pruning must go on from what there is.
    fn choose(&mut self, of: &mut Densified<'_>, free: usize) -> bool {
        let (n, limit) = (of.model.gaussians, f64::from(of.settings.density.dead_opacity));
        self.dead.clear();
        self.cumulative.clear();
        self.moves.clear();
        let mut sum = 0.0;
        for (i, g) in of.model.geometry(of.device).iter().enumerate() {
            let o = opacity(g.opacity_logit);
            if o < limit {
                self.dead.push(i as u32);
            } else {
                sum += worth(g, o);
            }
            self.cumulative.push(sum);
        }
        if sum <= 0.0 {
            return false;
        }
        self.copies[..n].fill(0);
        let (dead, room) = (self.dead.len(), self.dead.len() + free);
        for k in 0..room {
            let at: f64 = of.rng.random_range(0.0..sum);
            let source = self.cumulative.partition_point(|c| *c <= at).min(n - 1);
            if self.copies[source] + 1 >= MOST_COPIES as u32 {
                continue;
            }
            self.copies[source] += 1;
            let to = if k < dead { self.dead[k] } else { u32::MAX };
            self.moves.push([source as u32, to]);
        }
        true
    }

    fn apply(&self, of: &mut Densified<'_>) {
        let dead_opacity = f64::from(of.settings.density.dead_opacity);
        for (g, copies) in of.model.geometry_mut(of.device).iter_mut().zip(&self.copies) {
            if *copies > 0 {
                let (each, factor) = self.split(opacity(g.opacity_logit), *copies as usize + 1);
                g.opacity_logit = logit(each.max(dead_opacity));
                g.log_scale = g.log_scale.map(|s| s + factor.ln() as f32);
            }
        }
        for [from, to] in self.moves.iter().map(|m| m.map(|v| v as usize)) {
            let to = if to == u32::MAX as usize {
                of.model.gaussians += 1;
                of.model.counters.added += 1;
                of.model.gaussians - 1
            } else {
                of.model.counters.relocated += 1;
                to
            };
            of.model.copy(of.device, from, to);
            of.displace(to);
        }
    }
}

impl Densified<'_> {
    /// Moves a copy to a place drawn from the Gaussian it was copied from.
    fn displace(&mut self, index: usize) {
        let spread = self.settings.density.spread;
        if spread <= 0.0 {
            return;
        }
        let g = &mut self.model.geometry_mut(self.device)[index];
        let [w, x, y, z] = g.rotation;
        let rotation = Quat::from_xyzw(x, y, z, w).normalize();
        // A Gaussian larger than the scene (log scales may be 40) sends no copy out of it.
        let extent = self.model.extent;
        let along = g.log_scale.map(|s| s.exp().min(extent) * normal(self.rng) * spread);
        let offset = rotation * Vec3::from(along);
        // A zero quaternion has no direction: the copy then stays where its source is.
        if offset.is_finite() {
            for (mean, offset) in g.mean.iter_mut().zip(offset.to_array()) {
                *mean += offset;
            }
        }
    }

    fn decay_opacities(&mut self, progress: f32) {
        let amount = f64::from(self.settings.regularise.opacity_decay * (1.0 - progress));
        if amount <= 0.0 {
            return;
        }
        for g in self.model.geometry_mut(self.device) {
            g.opacity_logit = logit(opacity(g.opacity_logit) - amount);
        }
    }
}

/// Density control: when it is due, and how it is done.
pub(crate) struct Density {
    strategy: &'static dyn Strategy,
    scratch: Scratch,
    /// Pictures visited when it was last done.
    last: f64,
    /// Update of the last flush.
    last_flush: u32,
}

impl Density {
    /// Room for so many Gaussians.
    pub fn new(capacity: usize) -> Self {
        Self { strategy: &Keep, scratch: Scratch::new(capacity), last: 0.0, last_flush: 0 }
    }

    /// Begins with other Gaussians.
    pub fn restart(&mut self, chosen: Chosen) {
        (self.last, self.last_flush) = (0.0, 0);
        self.strategy = match chosen {
            Chosen::None => &Keep,
            Chosen::Prune => &Prune,
            Chosen::Relocate | Chosen::Auto => &Relocate,
        };
    }

    /// From here on, until others are loaded, the number of Gaussians is the caller's.
    pub fn keep_number(&mut self) {
        self.strategy = &Keep;
    }

    /// Gaussians that a window of cells may begin with: all of the `most` that the device holds, but for those that densification adds.
    pub fn window_capacity(&self, most: usize, settings: &TrainSettings, progress: f32) -> usize {
        let d = &settings.density;
        let grows = self.strategy.grows() && progress < d.until;
        if grows { (most as f32 / (1.0 + d.growth)) as usize } else { most }
    }

    /// Runs density control when its time has come.
    pub fn control(
        &mut self,
        device: &mut Device,
        model: &mut Model,
        schedule: &Schedule,
        settings: &TrainSettings,
        (rng, progress): (&mut Pcg64Mcg, f32),
    ) -> Result<(), TrainError> {
        let _phase = tracing::trace_span!("density control").entered();
        let since_flush = model.updates - self.last_flush;
        let interval = settings.density.interval(schedule.expected_steps());
        let since = (schedule.visited - self.last) as f32;
        let paged = model.scene.is_paged();
        let share = if paged { model.density_due(since, interval) } else { since / interval.max(1) as f32 };
        let due = share >= 1.0 && (!paged || model.window_ends());
        if !self.strategy.acts() || progress >= settings.density.until || !due {
            if since_flush >= FLUSH_EVERY {
                model.flush(device)?;
                self.last_flush = model.updates;
            }
            return Ok(());
        }
        model.flush(device)?;
        (self.last_flush, self.last) = (model.updates, schedule.visited);
        let mut of = Densified { device, model, settings, rng };
        of.decay_opacities(progress);
        // Gaussians that went bad in spite of everything leave.
        of.model.remove_where(of.device, |g| !g.is_finite());
        self.strategy.densify(&mut self.scratch, &mut of)
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
