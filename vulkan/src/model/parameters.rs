//! Gaussians in and out of the arena: the only place that knows how their parameters lie in memory.

use super::moments::{HEAVY, ShMoments};
use super::state;
use crate::arena::Arena;
use crate::layout::Section;
use config::plan::Plan;
use models::cloud::{GaussianCloud, sh_coefficients};

/// Nearer to an opacity of 1 than this the derivative is lost in rounding.
pub(crate) const LEAST_LEFT: f32 = 1e-4;

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

    fn hold(&mut self) {
        self.second = [[HEAVY; 4]; 3];
    }

    /// Root mean square over the steps of the loss's derivative by the logarithm of the opacity: what the loss may lose with this
    /// Gaussian, as Optimal Brain Damage (LeCun et al. 1990) reckons for a network's weights. `unbias` is what Adam multiplies second
    /// moments by.
    pub fn sensitivity(&self, unbias: f32) -> f32 {
        // The moment is of the derivative by the logit, which is that by the logarithm times 1 - opacity.
        let left = 1.0 / (1.0 + self.opacity_logit.exp());
        (self.second[0][3] * unbias).sqrt() / left.max(LEAST_LEFT)
    }

    /// Of a record.
    pub fn of_record(record: &[u8]) -> Self {
        bytemuck::pod_read_unaligned(&record[..size_of::<Self>()])
    }

    /// Puts it into a record.
    pub fn into_record(self, record: &mut [u8]) {
        record[..size_of::<Self>()].copy_from_slice(bytemuck::bytes_of(&self));
    }

    pub fn is_finite(&self) -> bool {
        let numbers = self.mean.iter().chain(&self.log_scale).chain(&self.rotation);
        self.opacity_logit.is_finite() && numbers.into_iter().all(|v| v.is_finite())
    }
}

/// Where a Gaussian is.
pub(crate) enum Held<'a> {
    /// Its place on the device.
    OnDevice(usize),
    /// Its record.
    InFile(&'a [u8]),
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

    /// Columns of one Gaussian besides the geometry: where they lie in the arena, and how many bytes each is.
    fn columns_of(&self, index: usize) -> [(Section, std::ops::Range<usize>); 3] {
        let of = |section: Section, bytes: usize| (section, index * bytes..(index + 1) * bytes);
        let moments = |m: ShMoments| of(m.section, m.bytes_each());
        [of(self.sh, 16 * self.columns), moments(self.sh_first), moments(self.sh_second)]
    }

    /// Copies Gaussian `index` with its moments out of the arena, as a record of [`Plan::record_bytes`].
    pub fn read_record(&self, arena: &Arena, index: usize, record: &mut [u8]) {
        let (geometry, mut rest) = record.split_at_mut(size_of::<Geometry>());
        geometry.copy_from_slice(bytemuck::bytes_of(&self.geometry(arena)[index]));
        for (section, range) in self.columns_of(index) {
            let (column, after) = rest.split_at_mut(range.len());
            column.copy_from_slice(&arena.slice::<u8>(section)[range]);
            rest = after;
        }
    }

    /// Copies a record to place `index` of the arena.
    pub fn write_record(&self, arena: &mut Arena, index: usize, record: &[u8]) {
        let (geometry, mut rest) = record.split_at(size_of::<Geometry>());
        self.geometry_mut(arena)[index] = bytemuck::pod_read_unaligned(geometry);
        for (section, range) in self.columns_of(index) {
            let (column, after) = rest.split_at(range.len());
            arena.slice_mut::<u8>(section)[range].copy_from_slice(column);
            rest = after;
        }
    }

    /// Sets the state word of a record.
    pub fn write_state(record: &mut [u8], state: f32) {
        let at = std::mem::offset_of!(Geometry, state);
        record[at..at + size_of::<f32>()].copy_from_slice(bytemuck::bytes_of(&state));
    }

    /// Gives a record the second moments of another one.
    pub fn begin_with(&self, record: &mut [u8], donor: &[u8]) {
        let at = std::mem::offset_of!(Geometry, second);
        let sh = record.len() - self.sh_second.bytes_each();
        for range in [at..size_of::<Geometry>(), sh..record.len()] {
            record[range.clone()].copy_from_slice(&donor[range]);
        }
    }

    /// Holds Gaussian `index` where it is.
    pub fn hold(&self, arena: &mut Arena, index: usize) {
        self.geometry_mut(arena)[index].hold();
        self.sh_second.fill(arena, index);
    }

    /// Forgets the moments of Gaussian `index`.
    pub fn forget(&self, arena: &mut Arena, index: usize) {
        self.geometry_mut(arena)[index].forget();
        self.sh_first.forget(arena, index);
        self.sh_second.forget(arena, index);
    }
}

/// An empty cloud of `degree` that keeps its memory.
pub(crate) fn clear(cloud: &mut GaussianCloud, degree: u8) {
    cloud.sh_degree = degree;
    cloud.means.clear();
    cloud.log_scales.clear();
    cloud.rotations.clear();
    cloud.opacity_logits.clear();
    cloud.sh.clear();
}

/// A record of Gaussian `from` with its first `coefficients` numbers of SH, without moments.
pub(super) fn record_of(cloud: &GaussianCloud, from: usize, coefficients: usize, record: &mut [u8]) {
    let stride = cloud.sh_stride();
    let coefficients = &cloud.sh[from * stride..from * stride + coefficients];
    let geometry = Geometry {
        mean: cloud.means[from],
        opacity_logit: cloud.opacity_logits[from],
        log_scale: cloud.log_scales[from],
        state: state::state(state::degree_in_use(coefficients)),
        rotation: cloud.rotations[from],
        ..bytemuck::Zeroable::zeroed()
    };
    let (head, rest) = record.split_at_mut(size_of::<Geometry>());
    head.copy_from_slice(bytemuck::bytes_of(&geometry));
    let (sh, zero) = rest.split_at_mut(4 * coefficients.len());
    sh.copy_from_slice(bytemuck::cast_slice(coefficients));
    zero.fill(0);
}

/// Adds what a record holds to a cloud of the plan's degree.
pub(super) fn push_record(cloud: &mut GaussianCloud, plan: &Plan, record: &[u8]) {
    let (g, rest) = (Geometry::of_record(record), &record[size_of::<Geometry>()..]);
    cloud.means.push(g.mean);
    cloud.opacity_logits.push(g.opacity_logit);
    cloud.log_scales.push(g.log_scale);
    cloud.rotations.push(g.rotation);
    let numbers = 3 * sh_coefficients(plan.sh_degree);
    cloud.sh.extend(rest.chunks_exact(4).take(numbers).map(bytemuck::pod_read_unaligned::<f32>));
}

/// Moves row `row` of a cloud of the plan's degree by `share` of the way to what a record holds.
pub(super) fn blend_record(cloud: &mut GaussianCloud, row: usize, plan: &Plan, record: &[u8], share: f32) {
    let (g, rest) = (Geometry::of_record(record), &record[size_of::<Geometry>()..]);
    let towards = |to: &mut f32, from: f32| *to += share * (from - *to);
    let blend = |to: &mut [f32], from: &[f32]| to.iter_mut().zip(from).for_each(|(to, from)| towards(to, *from));
    blend(&mut cloud.means[row], &g.mean);
    blend(&mut cloud.log_scales[row], &g.log_scale);
    blend(&mut cloud.rotations[row], &g.rotation);
    towards(&mut cloud.opacity_logits[row], g.opacity_logit);
    let numbers = 3 * sh_coefficients(plan.sh_degree);
    let sh = &mut cloud.sh[row * numbers..(row + 1) * numbers];
    sh.iter_mut().zip(rest.chunks_exact(4)).for_each(|(to, from)| towards(to, bytemuck::pod_read_unaligned(from)));
}
