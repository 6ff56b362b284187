//! Gaussians in and out of the arena: the only place that knows how a row lies in memory.

use super::moments::MomentRows;
use super::{TrainError, Trainer, degrees};
use crate::arena::{Arena, Section};
use config::plan::Plan;
use models::cloud::{GaussianCloud, sh_coefficients};

/// vec4 per Gaussian in `geometry`: three of parameters, three of first, three of second moments.
pub(crate) const GEOMETRY: usize = 9;

/// What became of a cloud's rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// Rows now on the device.
    pub loaded: usize,
    /// Rows with numbers that are not finite or a quaternion that cannot be normalised.
    pub dropped_unsound: usize,
    /// Rows beyond the plan's capacity; the least important (opacity × area) made way.
    pub dropped_over_capacity: usize,
}

/// Where the parameters lie.
#[derive(Clone, Copy)]
pub(crate) struct Rows {
    pub geometry: Section,
    pub sh: Section,
    pub sh_first: MomentRows,
    pub sh_second: MomentRows,
    pub columns: usize,
}

impl Rows {
    pub fn new(arena: &Arena, plan: &Plan) -> Self {
        let columns = config::plan::sh_columns(plan.sh_degree) as usize;
        let moments = |name| MomentRows::new(arena.section(name), columns, plan.half_moments);
        Self {
            geometry: arena.section("geometry"),
            sh: arena.section("sh"),
            sh_first: moments("sh_first_moment"),
            sh_second: moments("sh_second_moment"),
            columns,
        }
    }

    /// Copies row `from` to `to` with its second moments; the first moments of both are forgotten.
    ///
    /// Forgetting the second ones too, as 3DGS-MCMC does, makes the next steps of both ten times too long: at the global
    /// step count Adam no longer corrects the bias of a second moment that starts from zero.
    pub fn copy(&self, arena: &mut Arena, from: usize, to: usize) {
        let geometry = arena.slice_mut::<[f32; 4]>(self.geometry);
        geometry.copy_within(from * GEOMETRY..(from + 1) * GEOMETRY, to * GEOMETRY);
        for row in [from, to] {
            geometry[row * GEOMETRY + 3..row * GEOMETRY + 6].fill([0.0; 4]);
        }
        let columns = self.columns;
        arena.slice_mut::<[f32; 4]>(self.sh).copy_within(from * columns..(from + 1) * columns, to * columns);
        self.sh_second.copy(arena, from, to);
        for row in [from, to] {
            self.sh_first.forget(arena, row);
        }
    }

    /// Moves row `from` to `to` with its moments.
    pub fn shift(&self, arena: &mut Arena, from: usize, to: usize) {
        let geometry = arena.slice_mut::<[f32; 4]>(self.geometry);
        geometry.copy_within(from * GEOMETRY..(from + 1) * GEOMETRY, to * GEOMETRY);
        let columns = self.columns;
        arena.slice_mut::<[f32; 4]>(self.sh).copy_within(from * columns..(from + 1) * columns, to * columns);
        for moments in [self.sh_first, self.sh_second] {
            moments.copy(arena, from, to);
        }
    }

    pub fn forget(&self, arena: &mut Arena, row: usize) {
        let geometry = arena.slice_mut::<[f32; 4]>(self.geometry);
        geometry[row * GEOMETRY + 3..(row + 1) * GEOMETRY].fill([0.0; 4]);
        self.sh_first.forget(arena, row);
        self.sh_second.forget(arena, row);
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
    /// Replaces the Gaussians and starts the schedule anew. Rows that are not sound are left out, and so are the least
    /// important ones beyond the plan's capacity.
    ///
    /// # Errors
    /// [`TrainError::Empty`] when nothing remains.
    pub fn load(&mut self, cloud: &GaussianCloud) -> Result<LoadReport, TrainError> {
        let mut keep: Vec<usize> = (0..cloud.len()).filter(|i| cloud.row_is_sound(*i)).collect();
        let mut report = LoadReport { dropped_unsound: cloud.len() - keep.len(), ..LoadReport::default() };
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
            return Err(TrainError::Empty { unsound: report.dropped_unsound });
        }
        let rows = self.rows;
        let stride = cloud.sh_stride();
        let coefficients = sh_coefficients(self.plan.sh_degree.min(cloud.sh_degree)) * 3;
        for (to, &from) in keep.iter().enumerate() {
            let coefficients = &cloud.sh[from * stride..from * stride + coefficients];
            let (m, s, q) = (cloud.means[from], cloud.log_scales[from], cloud.rotations[from]);
            let geometry = &mut self.arena.slice_mut::<[f32; 4]>(rows.geometry)[to * GEOMETRY..];
            geometry[0] = [m[0], m[1], m[2], cloud.opacity_logits[from]];
            geometry[1] = [s[0], s[1], s[2], degrees::state(degrees::degree_in_use(coefficients))];
            geometry[2] = q;
            let sh = &mut self.arena.slice_mut::<f32>(rows.sh)[to * rows.columns * 4..(to + 1) * rows.columns * 4];
            sh.fill(0.0);
            sh[..coefficients.len()].copy_from_slice(coefficients);
            rows.forget(&mut self.arena, to);
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
        let rows = self.rows;
        for g in self.arena.slice::<[f32; 4]>(rows.geometry).chunks_exact(GEOMETRY).take(self.gaussians) {
            cloud.means.push([g[0][0], g[0][1], g[0][2]]);
            cloud.opacity_logits.push(g[0][3]);
            cloud.log_scales.push([g[1][0], g[1][1], g[1][2]]);
            cloud.rotations.push(g[2]);
        }
        for sh in self.arena.slice::<f32>(rows.sh).chunks_exact(rows.columns * 4).take(self.gaussians) {
            cloud.sh.extend_from_slice(&sh[..stride]);
        }
        Ok(())
    }
}
