//! A scene that grows while it is trained: Gaussians of new ground come to those there are, and others move or go, while all that
//! nobody touches keeps its place, its moments and its part of the schedule.

use super::kept::LoadReport;
use super::parameters::{Geometry, LEAST_LEFT, record_of};
use super::{Model, common_degree, state};
use crate::device::Device;
use crate::error::TrainError;
use config::training::TrainSettings;
use models::cloud::{GaussianCloud, sh_coefficients};

/// Gaussians among which one is sought whose second moments new ones begin with.
pub(super) const SAMPLED: usize = 1024;

/// A Gaussian as it is trained.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trained {
    /// Metres.
    pub mean: [f32; 3],
    /// Natural logarithms of metres.
    pub log_scale: [f32; 3],
    /// w, x, y, z.
    pub rotation: [f32; 4],
    /// Opacity before the sigmoid.
    pub opacity_logit: f32,
    /// What the loss may lose with it: root mean square, over the steps since the last [`Trainer::load`](crate::trainer::Trainer::load) (the last thousand above all), of
    /// the loss's derivative by the logarithm of the opacity. 0 before the first step; infinite where the Gaussian is too opaque for
    /// a derivative to be left.
    pub sensitivity: f32,
}

impl Trained {
    /// `unbias`: what the second moments are multiplied by.
    pub(super) fn of(g: &Geometry, unbias: f32) -> Self {
        let Geometry { mean, log_scale, rotation, opacity_logit, .. } = *g;
        let is_opaque = opacity_logit > -LEAST_LEFT.ln();
        let sensitivity = if is_opaque { f32::INFINITY } else { g.sensitivity(unbias) };
        Self { mean, log_scale, rotation, opacity_logit, sensitivity }
    }

    /// Opacity-weighted area of the disc spanned by its two longest axes, m²: how much of the ground it covers.
    pub fn covers_m2(&self) -> f32 {
        let [a, b, c] = self.log_scale;
        let area = a + b + c - a.min(b).min(c);
        std::f32::consts::PI * area.exp() / (1.0 + (-self.opacity_logit).exp())
    }
}

/// A box of space whose edges run along the axes, metres: which Gaussians are visited. Of a scene in cells the others are not read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundingBox {
    /// Its corner to the west, the south and below.
    pub low: [f32; 3],
    /// The corner across.
    pub high: [f32; 3],
}

impl BoundingBox {
    /// Everywhere.
    pub const ALL: Self = Self { low: [f32::NEG_INFINITY; 3], high: [f32::INFINITY; 3] };

    /// Whether a mean lies in it. One that is not a number is everywhere.
    pub fn holds(&self, mean: [f32; 3]) -> bool {
        (0..3).all(|k| !(mean[k] < self.low[k] || mean[k] > self.high[k]))
    }
}

/// What becomes of a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Fate {
    /// Nothing.
    Stays,
    /// It lies elsewhere, turned.
    Moves {
        /// Metres.
        mean: [f32; 3],
        /// w, x, y, z.
        rotation: [f32; 4],
    },
    /// It is taken out.
    Goes,
}

impl Model {
    /// Shows every Gaussian of `within`, in order. `unbias`: what Adam multiplies second moments by.
    pub fn each(
        &mut self,
        device: &mut Device,
        within: &BoundingBox,
        unbias: f32,
        mut see: impl FnMut(&Trained),
    ) -> Result<(), TrainError> {
        self.flush(device)?;
        if self.scene.is_paged() {
            self.leave_for_file(device)?;
            return self.page(device, |scene, _| scene.each_within(within, |g| see(&Trained::of(g, unbias))));
        }
        let geometry = self.geometry(device).iter();
        geometry.filter(|g| within.holds(g.mean)).for_each(|g| see(&Trained::of(g, unbias)));
        Ok(())
    }

    /// Moves Gaussians of `within` and takes others out, as `fate` says of each in the order of [`Model::each`]; never the last one.
    /// Returns how many went.
    pub fn revise(
        &mut self,
        device: &mut Device,
        within: &BoundingBox,
        unbias: f32,
        mut fate: impl FnMut(&Trained) -> Fate,
    ) -> Result<usize, TrainError> {
        self.flush(device)?;
        let before = self.total();
        if self.scene.is_paged() {
            self.leave_for_file(device)?;
            self.page(device, |scene, _| scene.revise(within, |g| fate(&Trained::of(g, unbias))))?;
            return Ok(before - self.total());
        }
        let mut gone: Vec<u32> = Vec::new();
        for (i, g) in self.geometry_mut(device).iter_mut().enumerate().filter(|(_, g)| within.holds(g.mean)) {
            match fate(&Trained::of(g, unbias)) {
                Fate::Stays => {}
                Fate::Moves { mean, rotation } => (g.mean, g.rotation) = (mean, rotation),
                Fate::Goes => gone.push(i as u32),
            }
        }
        // From the last one on: what takes a place is one that stays.
        for index in gone.iter().rev().map(|i| *i as usize) {
            if self.gaussians <= 1 {
                break;
            }
            self.gaussians -= 1;
            if index != self.gaussians {
                self.parameters.shift(&mut device.arena, self.gaussians, index);
            }
        }
        self.count_missing(device);
        Ok(before - self.total())
    }

    /// Removes Gaussians of the device, but never the last one; the last ones take the places of those removed.
    pub fn remove_where(&mut self, device: &mut Device, leaves: impl Fn(&Geometry) -> bool) {
        let mut index = 0;
        while index < self.gaussians && self.gaussians > 1 {
            if !leaves(&self.geometry(device)[index]) {
                index += 1;
                continue;
            }
            self.gaussians -= 1;
            if index != self.gaussians {
                self.parameters.shift(&mut device.arena, self.gaussians, index);
                self.scene.place(self.gaussians, index);
            }
            self.counters.pruned += 1;
        }
        self.scene.truncate(self.gaussians);
    }

    /// Adds Gaussians, as many as find room; those that are not finite are left out. A scene that outgrows the device goes into cells.
    pub fn extend(
        &mut self,
        device: &mut Device,
        settings: &TrainSettings,
        cloud: &GaussianCloud,
    ) -> Result<LoadReport, TrainError> {
        self.flush(device)?;
        let valid: Vec<usize> = (0..cloud.len()).filter(|i| cloud.is_valid(*i)).collect();
        let room = device.plan().scene.saturating_sub(self.total());
        let report = LoadReport {
            loaded: valid.len().min(room),
            dropped_non_finite: cloud.len() - valid.len(),
            dropped_over_capacity: valid.len().saturating_sub(room),
        };
        let new = &valid[..report.loaded];
        if !self.scene.is_paged() && self.gaussians + report.loaded > device.plan().gaussians {
            self.enter_cells(device, settings)?;
        }
        let coefficients = sh_coefficients(device.plan().sh_degree.min(cloud.sh_degree)) * 3;
        if self.scene.is_paged() {
            self.leave_for_file(device)?;
            let parameters = self.parameters;
            self.page(device, |scene, _| scene.extend(cloud, new, coefficients, &parameters))?;
            return Ok(report);
        }
        let donor = self.donor(device);
        let degree = common_degree(device.plan(), self.own_degrees);
        let Self { record, parameters, .. } = self;
        for from in new {
            let to = self.gaussians;
            record_of(cloud, *from, coefficients, record);
            parameters.write_record(&mut device.arena, to, record);
            let second = donor.map(|donor| {
                parameters.sh_second.copy(&mut device.arena, donor, to);
                parameters.geometry(&device.arena)[donor].second
            });
            let g = &mut parameters.geometry_mut(&mut device.arena)[to];
            // It missed nothing before it was there.
            g.state = state::up_to(g.state, self.updates);
            if let Some(degree) = degree {
                g.state = state::with_degree(g.state, degree);
            }
            g.second = second.unwrap_or(g.second);
            self.gaussians += 1;
        }
        self.count_missing(device);
        Ok(report)
    }

    /// The [donor](donor_of) among those on the device.
    fn donor(&self, device: &Device) -> Option<usize> {
        let every = self.gaussians.div_ceil(SAMPLED).max(1);
        donor_of(self.geometry(device).iter().enumerate().step_by(every).map(|(i, g)| (pull_of(g), i)))
    }
}

/// How hard the position was pulled.
pub(super) fn pull_of(g: &Geometry) -> f32 {
    g.second[0][..3].iter().sum()
}

/// The Gaussian whose second moments new ones begin with: from zero, their first steps would be several times too long, as Adam no
/// longer corrects that bias after many steps ([`Parameters::copy`](super::parameters::Parameters::copy)). Its position is
/// [pulled](pull_of) harder than three quarters of those sampled are, as new ones are; none before the first step.
pub(super) fn donor_of<T: Copy + Ord>(sampled: impl Iterator<Item = (f32, T)>) -> Option<T> {
    let mut moved: Vec<(f32, T)> = sampled.filter(|(pull, _)| *pull > 0.0 && pull.is_finite()).collect();
    let at = moved.len() * 3 / 4;
    (at < moved.len()).then(|| moved.select_nth_unstable_by(at, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))).1.1)
}

#[cfg(test)]
mod tests {
    use config::plan::{Plan, PlanRequest};

    use super::*;
    use crate::fixture::Fixture;
    use crate::gpu::Gpu;
    use crate::synthetic::{cloud, photo, plain, posed, view};

    fn trainer(views: u32) -> Option<Fixture> {
        let Ok(gpu) = Gpu::open(None) else {
            needs::missing(needs::Need::Vulkan, "no Vulkan device");
            return None;
        };
        let request = PlanRequest { width: 48, height: 32, views, max_gaussians: Some(200), ..Default::default() };
        let mut t = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &plain()).unwrap();
        for k in 0..views {
            let v = view(48, 32);
            t.add_view(&posed(&v, &photo(u64::from(k), &v)), None).unwrap();
        }
        Some(t)
    }

    fn snapshot(t: &mut Fixture) -> GaussianCloud {
        let mut out = GaussianCloud::default();
        t.snapshot(&mut out).unwrap();
        out
    }

    #[test]
    fn new_gaussians_come_to_the_trained_ones_which_keep_places_and_moments() {
        let Some(mut t) = trainer(1) else { return };
        t.load(&cloud(1, 80, 0)).unwrap();
        (0..6).for_each(|_| _ = t.step().unwrap());
        let before = snapshot(&mut t);
        let moments =
            |t: &Fixture| t.model.geometry(&t.device)[..80].iter().map(|g| (g.first, g.second)).collect::<Vec<_>>();
        let (then, steps) = (moments(&t), t.steps());
        let mut more = cloud(2, 150, 0);
        more.means[3][1] = f32::NAN;
        let report = t.extend(&more).unwrap();
        assert_eq!((report.loaded, report.dropped_non_finite, report.dropped_over_capacity), (120, 1, 29));
        assert_eq!((t.gaussians(), t.steps()), (200, steps));
        let after = snapshot(&mut t);
        assert_eq!(after.means[..80], before.means[..]);
        assert_eq!(after.sh[..80 * after.sh_stride()], before.sh[..]);
        assert_eq!(after.means[80..83], more.means[..3]);
        assert_eq!(after.means[83], more.means[4], "what is no number is left out");
        assert!(moments(&t) == then);
        let new = t.model.geometry(&t.device)[90];
        assert!(new.second[0][0] > 0.0 && new.first == [[0.0; 4]; 3], "the first step is of the usual length");
        // The next steps move new ones no further than the first steps of all moved the old ones.
        let first = cloud(1, 80, 0);
        let furthest = |a: &[[f32; 3]], b: &[[f32; 3]]| {
            let apart = |(p, q): (&[f32; 3], &[f32; 3])| (0..3).map(|k| (p[k] - q[k]).abs()).fold(0.0, f32::max);
            a.iter().zip(b).map(apart).fold(0.0, f32::max)
        };
        (0..6).for_each(|_| _ = t.step().unwrap());
        let later = snapshot(&mut t);
        let (old, new) = (furthest(&first.means, &before.means), furthest(&after.means[80..], &later.means[80..]));
        assert!(new > 0.0 && new < 3.0 * old, "{new} {old}");
        assert_eq!(t.gaussians(), 200, "their number is the caller's");
    }

    #[test]
    fn gaussians_move_and_go_where_they_are_and_the_others_stay_to_the_bit() {
        let Some(mut t) = trainer(1) else { return };
        t.load(&cloud(1, 60, 0)).unwrap();
        (0..3).for_each(|_| _ = t.step().unwrap());
        let before = snapshot(&mut t);
        let turned = [0.0, 1.0, 0.0, 0.0];
        let mut numbers = 0..;
        let gone = t
            .revise(&BoundingBox::ALL, |g| match numbers.next().unwrap_or(0) {
                0..10 => Fate::Goes,
                10..20 => Fate::Moves { mean: [g.mean[0] + 1.0, g.mean[1], g.mean[2]], rotation: turned },
                59 => Fate::Goes,
                _ => Fate::Stays,
            })
            .unwrap();
        assert_eq!((gone, t.gaussians()), (11, 49));
        let after = snapshot(&mut t);
        assert_eq!(after.means[20..49], before.means[20..49]);
        for i in 10..20 {
            assert_eq!(after.means[i][0], before.means[i][0] + 1.0);
            assert_eq!(after.rotations[i], turned);
        }
        let mut filled = after.means[..10].to_vec();
        filled.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let mut last = before.means[49..59].to_vec();
        last.sort_by(|a, b| a[0].total_cmp(&b[0]));
        assert_eq!(filled, last, "the last ones take the places that became free");
        assert!(t.step().unwrap().loss.is_finite());
        assert_eq!(t.revise(&BoundingBox::ALL, |_| Fate::Goes).unwrap(), 48);
        assert_eq!(t.gaussians(), 1, "never the last one");
    }

    #[test]
    fn sensitivity_says_by_how_much_the_loss_moves_with_an_opacity() {
        let Some(mut t) = trainer(1) else { return };
        let first = cloud(1, 80, 0);
        t.load(&first).unwrap();
        t.step().unwrap();
        let mut sensitive = Vec::new();
        t.each(&BoundingBox::ALL, |g| sensitive.push(g.sensitivity)).unwrap();
        let mut order: Vec<usize> = (0..80).collect();
        order.sort_by(|a, b| sensitive[*b].total_cmp(&sensitive[*a]));
        let mut loss_with = |i: usize, factor: f32| {
            let mut other = first.clone();
            let o = factor / (1.0 + (-first.opacity_logits[i]).exp());
            other.opacity_logits[i] = (o / (1.0 - o)).ln();
            t.load(&other).unwrap();
            t.step().unwrap().loss
        };
        for i in order[..5].iter().copied() {
            let moved = (loss_with(i, 1.01) - loss_with(i, 0.99)).abs() / 0.02;
            // Pixels at the cut-off come and go; the derivative knows nothing of them.
            assert!((moved / sensitive[i] - 1.0).abs() < 0.2, "{i}: {moved} {}", sensitive[i]);
        }
        assert!(sensitive[order[79]] < 0.2 * sensitive[order[0]]);
    }

    #[test]
    fn a_schedule_that_begins_anew_leaves_gaussians_and_steps_as_they_are() {
        let Some(mut t) = trainer(1) else { return };
        t.load(&cloud(1, 40, 0)).unwrap();
        (0..5).for_each(|_| _ = t.step().unwrap());
        assert_eq!(t.schedule().spent().0, 5);
        let before = snapshot(&mut t);
        t.schedule_mut().renew(0.5);
        assert_eq!((t.schedule().progress(), t.steps()), (0.5, 5));
        t.schedule_mut().renew(0.0);
        assert_eq!((t.schedule().spent().0, t.steps(), t.schedule().progress()), (0, 5, 0.0));
        assert_eq!(snapshot(&mut t), before);
        t.step().unwrap();
        assert_eq!((t.schedule().spent().0, t.steps()), (1, 6));
        t.load(&before).unwrap();
        assert_eq!((t.schedule().spent().0, t.steps()), (0, 0));
    }

    #[test]
    fn what_grows_is_the_same_bytes_whenever_it_grows_in_the_same_steps() {
        let grown = || {
            let mut t = trainer(3)?;
            t.load(&cloud(1, 60, 0)).unwrap();
            t.while_views_come();
            for k in 0..4 {
                (0..5).for_each(|_| _ = t.step().unwrap());
                t.extend(&cloud(10 + k, 20, 0)).unwrap();
                t.schedule_mut().renew(0.3);
            }
            (0..5).for_each(|_| _ = t.step().unwrap());
            Some(snapshot(&mut t))
        };
        assert_eq!(grown(), grown());
    }
}
