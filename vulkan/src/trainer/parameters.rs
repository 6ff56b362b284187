//! Gaussians in and out of the arena: the only place that knows how their parameters lie in memory.

use super::moments::ShMoments;
use super::{TrainError, Trainer, state};
use crate::arena::{Arena, Section};
use config::plan::Plan;
use models::cloud::{GaussianCloud, sh_coefficients};

/// Everything but SH of one Gaussian, with Adam's moments: nine vec4 of section `geometry`.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Geometry {
    pub mean: [f32; 3],
    pub opacity_logit: f32,
    pub log_scale: [f32; 3],
    pub state: f32,
    /// w, x, y, z.
    pub rotation: [f32; 4],
    /// First moments, in the order of the parameters; gradients after a pass that only computes those.
    pub first: [[f32; 4]; 3],
    /// Second moments.
    pub second: [[f32; 4]; 3],
}

impl Geometry {
    fn forget(&mut self) {
        (self.first, self.second) = ([[0.0; 4]; 3], [[0.0; 4]; 3]);
    }

    pub fn is_finite(&self) -> bool {
        let numbers = self.mean.iter().chain(&self.log_scale).chain(&self.rotation);
        self.opacity_logit.is_finite() && numbers.into_iter().all(|v| v.is_finite())
    }
}

/// What became of a cloud's Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// Gaussians now on the device.
    pub loaded: usize,
    /// Those with numbers that are not finite or a quaternion that cannot be normalised.
    pub dropped_non_finite: usize,
    /// Those beyond the plan's capacity; the least important (opacity × area) made way.
    pub dropped_over_capacity: usize,
}

/// Where the parameters lie.
#[derive(Clone, Copy)]
pub(crate) struct Parameters {
    geometry: Section,
    sh: Section,
    pub sh_first: ShMoments,
    pub sh_second: ShMoments,
    /// vec4 of SH per Gaussian.
    columns: usize,
}

impl Parameters {
    pub fn new(arena: &Arena, plan: &Plan) -> Self {
        let columns = config::plan::sh_columns(plan.sh_degree) as usize;
        let moments = |name| ShMoments::new(arena.section(name), columns, plan.half_moments);
        Self {
            geometry: arena.section("geometry"),
            sh: arena.section("sh"),
            sh_first: moments("sh_first_moment"),
            sh_second: moments("sh_second_moment"),
            columns,
        }
    }

    /// Of as many Gaussians as the plan holds.
    pub fn geometry<'a>(&self, arena: &'a Arena) -> &'a [Geometry] {
        arena.slice(self.geometry)
    }

    pub fn geometry_mut<'a>(&self, arena: &'a mut Arena) -> &'a mut [Geometry] {
        arena.slice_mut(self.geometry)
    }

    fn copy_sh(&self, arena: &mut Arena, from: usize, to: usize) {
        let columns = self.columns;
        arena.slice_mut::<[f32; 4]>(self.sh).copy_within(from * columns..(from + 1) * columns, to * columns);
    }

    /// Copies Gaussian `from` to `to` with its second moments; the first moments of both are forgotten.
    ///
    /// Forgetting the second ones too, as 3DGS-MCMC does, makes the next steps of both ten times too long: at the global
    /// step count Adam no longer corrects the bias of a second moment that starts from zero.
    pub fn copy(&self, arena: &mut Arena, from: usize, to: usize) {
        let geometry = self.geometry_mut(arena);
        geometry[from].first = [[0.0; 4]; 3];
        geometry[to] = geometry[from];
        self.copy_sh(arena, from, to);
        self.sh_second.copy(arena, from, to);
        for index in [from, to] {
            self.sh_first.forget(arena, index);
        }
    }

    /// Moves Gaussian `from` to `to` with its moments.
    pub fn shift(&self, arena: &mut Arena, from: usize, to: usize) {
        self.geometry_mut(arena).copy_within(from..from + 1, to);
        self.copy_sh(arena, from, to);
        for moments in [self.sh_first, self.sh_second] {
            moments.copy(arena, from, to);
        }
    }

    /// Forgets the moments of Gaussian `index`.
    pub fn forget(&self, arena: &mut Arena, index: usize) {
        self.geometry_mut(arena)[index].forget();
        self.sh_first.forget(arena, index);
        self.sh_second.forget(arena, index);
    }
}

/// An empty cloud of `degree` that keeps its memory.
pub(super) fn clear(cloud: &mut GaussianCloud, degree: u8) {
    cloud.sh_degree = degree;
    cloud.means.clear();
    cloud.log_scales.clear();
    cloud.rotations.clear();
    cloud.opacity_logits.clear();
    cloud.sh.clear();
}

impl Trainer {
    /// Replaces the Gaussians and starts the schedule anew. Those that are not finite are left out, and so are the least
    /// important ones beyond the plan's capacity.
    ///
    /// # Errors
    /// [`TrainError::Empty`] when nothing remains.
    pub fn load(&mut self, cloud: &GaussianCloud) -> Result<LoadReport, TrainError> {
        let mut keep: Vec<usize> = (0..cloud.len()).filter(|i| cloud.is_valid(*i)).collect();
        let mut report = LoadReport { dropped_non_finite: cloud.len() - keep.len(), ..LoadReport::default() };
        let capacity = self.plan.gaussians;
        if keep.len() > capacity {
            report.dropped_over_capacity = keep.len() - capacity;
            let weight = |i: &usize| {
                let s = cloud.log_scales[*i];
                let area = s.iter().sum::<f32>() - s.iter().copied().fold(f32::INFINITY, f32::min);
                area - (1.0 + (-cloud.opacity_logits[*i]).exp()).ln()
            };
            keep.select_nth_unstable_by(capacity, |a, b| weight(b).total_cmp(&weight(a)).then(a.cmp(b)));
            keep.truncate(capacity);
            keep.sort_unstable();
        }
        report.loaded = keep.len();
        if keep.is_empty() {
            return Err(TrainError::Empty { non_finite: report.dropped_non_finite });
        }
        let parameters = self.parameters;
        let stride = cloud.sh_stride();
        let coefficients = sh_coefficients(self.plan.sh_degree.min(cloud.sh_degree)) * 3;
        for (to, &from) in keep.iter().enumerate() {
            let coefficients = &cloud.sh[from * stride..from * stride + coefficients];
            let geometry = &mut parameters.geometry_mut(&mut self.arena)[to];
            geometry.mean = cloud.means[from];
            geometry.opacity_logit = cloud.opacity_logits[from];
            geometry.log_scale = cloud.log_scales[from];
            geometry.state = state::state(state::degree_in_use(coefficients));
            geometry.rotation = cloud.rotations[from];
            let width = parameters.columns * 4;
            let sh = &mut self.arena.slice_mut::<f32>(parameters.sh)[to * width..(to + 1) * width];
            sh.fill(0.0);
            sh[..coefficients.len()].copy_from_slice(coefficients);
            parameters.forget(&mut self.arena, to);
        }
        self.gaussians = keep.len();
        self.restart();
        Ok(report)
    }

    /// Writes the present parameters to `cloud`, reusing its memory.
    ///
    /// # Errors
    /// [`TrainError::Gpu`].
    pub fn snapshot(&mut self, cloud: &mut GaussianCloud) -> Result<(), TrainError> {
        self.flush()?;
        clear(cloud, self.plan.sh_degree);
        let stride = cloud.sh_stride();
        let parameters = self.parameters;
        for g in &parameters.geometry(&self.arena)[..self.gaussians] {
            cloud.means.push(g.mean);
            cloud.opacity_logits.push(g.opacity_logit);
            cloud.log_scales.push(g.log_scale);
            cloud.rotations.push(g.rotation);
        }
        let sh = self.arena.slice::<f32>(parameters.sh).chunks_exact(parameters.columns * 4);
        sh.take(self.gaussians).for_each(|sh| cloud.sh.extend_from_slice(&sh[..stride]));
        Ok(())
    }
}
