//! The Gaussian cloud as columns: the one type that initialisation fills, the trainer loads and reads back,
//! files store and the ground merges.
//!
//! Parameters are stored as they are optimised: log scales, logit opacities, SH coefficients around
//! `colour = 0.5 + C0·sh₀ + …` (3DGS's convention), unnormalised quaternions in **w, x, y, z** order (as in a
//! 3DGS PLY).

use serde::{Deserialize, Serialize};

pub(crate) use coarser::coarser;
pub use plausible::Plausible;
pub use turn::ShTurn;

mod coarser;
mod plausible;
mod turn;

/// Number of SH coefficients per colour channel for a degree 0…3.
pub const fn sh_coefficients(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// Y₀₀, the constant SH basis function.
pub const SH_C0: f32 = 0.282_094_79;

/// Logarithm of an extent that is none: two nanometres of a scene in metres.
const FLAT: f32 = -20.0;
/// Logit of an opacity that differs from 1 by less than any renderer shows.
const SOLID: f32 = 16.0;

/// The real SH basis functions above degree 0 at a unit vector, in 3DGS's order and signs.
pub fn sh_basis([x, y, z]: [f64; 3]) -> [f64; 15] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079_2 * x * y,
        -1.092_548_430_592_079_2 * y * z,
        0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079_2 * x * z,
        0.546_274_215_296_039_6 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * x * y * z,
        -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
    ]
}

/// N Gaussians, column by column; every column has the same N.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GaussianCloud {
    /// Highest SH degree stored, 0…3.
    pub sh_degree: u8,
    /// World positions, metres ENU.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithm of the standard deviations along the Gaussian's own axes, metres.
    pub log_scales: Vec<[f32; 3]>,
    /// Own axes → world, **w x y z**, normalised when used, not when stored.
    pub rotations: Vec<[f32; 4]>,
    /// logit(opacity).
    pub opacity_logits: Vec<f32>,
    /// N × D × 3 floats, D = [`sh_coefficients`]: for each Gaussian D coefficients, each r, g, b.
    pub sh: Vec<f32>,
}

impl Clone for GaussianCloud {
    fn clone(&self) -> Self {
        let mut of = Self::default();
        of.clone_from(self);
        of
    }

    /// Into the memory that is there: what was taken for a flight stays its own.
    fn clone_from(&mut self, from: &Self) {
        self.sh_degree = from.sh_degree;
        self.means.clone_from(&from.means);
        self.log_scales.clone_from(&from.log_scales);
        self.rotations.clone_from(&from.rotations);
        self.opacity_logits.clone_from(&from.opacity_logits);
        self.sh.clone_from(&from.sh);
    }
}

impl GaussianCloud {
    /// An empty cloud with room for `capacity` Gaussians.
    pub fn with_capacity(sh_degree: u8, capacity: usize) -> Self {
        Self {
            sh_degree,
            means: Vec::with_capacity(capacity),
            log_scales: Vec::with_capacity(capacity),
            rotations: Vec::with_capacity(capacity),
            opacity_logits: Vec::with_capacity(capacity),
            sh: Vec::with_capacity(capacity * sh_coefficients(sh_degree) * 3),
        }
    }

    /// An empty cloud with its memory taken from the system at once: what is planned for a flight cannot be refused in the midst of it.
    pub fn with_memory(sh_degree: u8, capacity: usize) -> Self {
        let mut cloud = Self::with_capacity(sh_degree, capacity);
        cloud.means.resize(capacity, [1.0; 3]);
        cloud.log_scales.resize(capacity, [1.0; 3]);
        cloud.rotations.resize(capacity, [1.0; 4]);
        cloud.opacity_logits.resize(capacity, 1.0);
        cloud.sh.resize(capacity * cloud.sh_stride(), 1.0);
        cloud.retain(|_| false);
        cloud
    }

    /// Colour of Gaussian `i` without what depends on the direction, red, green and blue, 0…1.
    pub fn color(&self, i: usize) -> [f32; 3] {
        let at = i * self.sh_stride();
        std::array::from_fn(|c| 0.5 + SH_C0 * self.sh[at + c])
    }

    /// Multiplies all colours, from wherever they are seen.
    pub fn multiply_colors(&mut self, factor: [f32; 3]) {
        let stride = self.sh_stride();
        for sh in self.sh.chunks_exact_mut(stride) {
            (0..3).for_each(|c| sh[c] += 0.5 / SH_C0);
            sh.iter_mut().enumerate().for_each(|(i, v)| *v *= factor[i % 3]);
            (0..3).for_each(|c| sh[c] -= 0.5 / SH_C0);
        }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there is none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Floats per Gaussian in `sh`.
    pub fn sh_stride(&self) -> usize {
        sh_coefficients(self.sh_degree) * 3
    }

    /// Appends one Gaussian; `sh` has [`Self::sh_stride`] floats.
    pub fn push(&mut self, mean: [f32; 3], log_scale: [f32; 3], rotation: [f32; 4], opacity_logit: f32, sh: &[f32]) {
        debug_assert_eq!(sh.len(), self.sh_stride());
        self.means.push(mean);
        self.log_scales.push(log_scale);
        self.rotations.push(rotation);
        self.opacity_logits.push(opacity_logit);
        self.sh.extend_from_slice(sh);
    }

    /// Whether row `i` holds only finite numbers and a quaternion that can be normalised.
    pub fn is_valid(&self, i: usize) -> bool {
        let stride = self.sh_stride();
        let q = self.rotations[i];
        let q2: f32 = q.iter().map(|v| v * v).sum();
        self.means[i].iter().chain(&self.log_scales[i]).all(|v| v.is_finite())
            && q2.is_finite()
            && q2 > 1e-20
            && self.opacity_logits[i].is_finite()
            && self.sh[i * stride..(i + 1) * stride].iter().all(|v| v.is_finite())
    }

    /// The median of each coordinate of the means; zeros for an empty cloud. A stray Gaussian far away does not move it.
    pub fn middle(&self) -> [f32; 3] {
        [0, 1, 2].map(|k| {
            let mut column: Vec<f32> = self.means.iter().map(|m| m[k]).collect();
            let half = column.len() / 2;
            if column.is_empty() { 0.0 } else { *column.select_nth_unstable_by(half, f32::total_cmp).1 }
        })
    }

    /// Opacity-weighted area of the disc spanned by a Gaussian's two longest axes, m²: how much of the ground it covers.
    pub fn covered_m2(&self, index: usize) -> f64 {
        let mut s = self.log_scales[index].map(f64::from);
        s.sort_by(f64::total_cmp);
        let opacity = 1.0 / (1.0 + (-f64::from(self.opacity_logits[index])).exp());
        opacity * std::f64::consts::PI * (s[1] + s[2]).exp()
    }

    /// Which rows remain when those that cover least are left out until `budget` are left.
    pub fn most_covering(&self, budget: usize) -> Vec<bool> {
        let mut keep = vec![true; self.len()];
        if self.len() > budget {
            let least = self.least_covering((0..self.len() as u32).collect(), budget);
            least.into_iter().for_each(|i| keep[i as usize] = false);
        }
        keep
    }

    /// Rows that cover least, until `budget` of them are left; of equals the first.
    pub fn least_covering(&self, rows: Vec<u32>, budget: usize) -> Vec<u32> {
        let over = rows.len().saturating_sub(budget);
        if over == 0 {
            return Vec::new();
        }
        let mut order: Vec<(f64, u32)> = rows.into_iter().map(|i| (self.covered_m2(i as usize), i)).collect();
        let by_area = |a: &(f64, u32), b: &(f64, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        // With a budget of nothing there is no row behind the last one that goes.
        let nth = over.min(order.len() - 1);
        order.select_nth_unstable_by(nth, by_area);
        order[..over].iter().map(|o| o.1).collect()
    }

    /// Keeps the rows for which `keep(index)` holds, in order; returns how many were removed.
    pub fn retain(&mut self, mut keep: impl FnMut(usize) -> bool) -> usize {
        let (n, stride) = (self.len(), self.sh_stride());
        let mut to = 0;
        for from in 0..n {
            if keep(from) {
                self.means[to] = self.means[from];
                self.log_scales[to] = self.log_scales[from];
                self.rotations[to] = self.rotations[from];
                self.opacity_logits[to] = self.opacity_logits[from];
                self.sh.copy_within(from * stride..(from + 1) * stride, to * stride);
                to += 1;
            }
        }
        self.means.truncate(to);
        self.log_scales.truncate(to);
        self.rotations.truncate(to);
        self.opacity_logits.truncate(to);
        self.sh.truncate(to * stride);
        n - to
    }

    /// The rows of these numbers, as a cloud of their own.
    pub fn rows(&self, rows: &[u32]) -> Self {
        let mut of = Self::with_capacity(self.sh_degree, rows.len());
        let stride = self.sh_stride();
        for i in rows.iter().map(|i| *i as usize) {
            let sh = &self.sh[i * stride..(i + 1) * stride];
            of.push(self.means[i], self.log_scales[i], self.rotations[i], self.opacity_logits[i], sh);
        }
        of
    }

    /// Row `i` becomes row `from` of another cloud; of its SH what this cloud has room for.
    pub fn set_row(&mut self, i: usize, other: &Self, from: usize) {
        self.means[i] = other.means[from];
        self.log_scales[i] = other.log_scales[from];
        self.rotations[i] = other.rotations[from];
        self.opacity_logits[i] = other.opacity_logits[from];
        let (own, theirs) = (self.sh_stride(), other.sh_stride());
        let both = own.min(theirs);
        self.sh[i * own..i * own + both].copy_from_slice(&other.sh[from * theirs..from * theirs + both]);
        self.sh[i * own + both..(i + 1) * own].fill(0.0);
    }

    /// Gives numbers to what other programs write as infinite: no extent at all, wholly opaque or wholly transparent.
    pub fn bring_in_limits(&mut self) {
        for v in self.log_scales.iter_mut().flatten().filter(|v| **v == f32::NEG_INFINITY) {
            *v = FLAT;
        }
        for v in self.opacity_logits.iter_mut().filter(|v| v.is_infinite()) {
            *v = SOLID.copysign(*v);
        }
    }

    /// Drops every row that is not [valid](Self::is_valid); returns how many.
    pub fn drop_invalid(&mut self) -> usize {
        let valid: Vec<bool> = (0..self.len()).map(|i| self.is_valid(i)).collect();
        self.retain(|i| valid[i])
    }

    /// Makes room for exactly `more` further Gaussians: a cloud that grows model by model never holds twice its size.
    pub fn reserve_exact(&mut self, more: usize) {
        self.means.reserve_exact(more);
        self.log_scales.reserve_exact(more);
        self.rotations.reserve_exact(more);
        self.opacity_logits.reserve_exact(more);
        self.sh.reserve_exact(more * self.sh_stride());
    }

    /// Appends another cloud; the lower SH degree is padded with zeros.
    pub fn extend(&mut self, other: &Self) {
        if other.sh_degree > self.sh_degree {
            self.raise_sh_degree(other.sh_degree);
        }
        self.means.extend_from_slice(&other.means);
        self.log_scales.extend_from_slice(&other.log_scales);
        self.rotations.extend_from_slice(&other.rotations);
        self.opacity_logits.extend_from_slice(&other.opacity_logits);
        let (from, to) = (other.sh_stride(), self.sh_stride());
        for row in other.sh.chunks_exact(from) {
            self.sh.extend_from_slice(row);
            self.sh.resize(self.sh.len() + to - from, 0.0);
        }
    }

    /// Cuts the stored SH degree down; what a lower one cannot say is gone.
    pub fn lower_sh_degree(&mut self, degree: u8) {
        if degree >= self.sh_degree {
            return;
        }
        let (from, to) = (self.sh_stride(), sh_coefficients(degree) * 3);
        for i in 0..self.len() {
            self.sh.copy_within(i * from..i * from + to, i * to);
        }
        self.sh.truncate(self.len() * to);
        self.sh_degree = degree;
    }

    /// Raises the stored SH degree; new coefficients are zero.
    pub fn raise_sh_degree(&mut self, degree: u8) {
        if degree <= self.sh_degree {
            return;
        }
        let from = self.sh_stride();
        self.sh_degree = degree;
        let to = self.sh_stride();
        let mut sh = Vec::with_capacity(self.len() * to);
        for row in self.sh.chunks_exact(from) {
            sh.extend_from_slice(row);
            sh.resize(sh.len() + to - from, 0.0);
        }
        self.sh = sh;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(v: f32, degree: u8) -> GaussianCloud {
        let mut c = GaussianCloud::with_capacity(degree, 1);
        let sh = vec![v; c.sh_stride()];
        c.push([v; 3], [v; 3], [1.0, 0.0, 0.0, 0.0], v, &sh);
        c
    }

    #[test]
    fn extending_with_a_higher_degree_pads_with_zeros() {
        let mut a = one(1.0, 0);
        a.extend(&one(2.0, 1));
        assert_eq!(a.sh_degree, 1);
        assert_eq!(a.len(), 2);
        assert_eq!(&a.sh[..12], &[1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(&a.sh[12..], &[2.0; 12]);
    }

    #[test]
    fn a_copy_goes_into_the_memory_that_was_taken_for_it() {
        let mut planned = GaussianCloud::with_memory(1, 100);
        let places = |c: &GaussianCloud| (c.means.as_ptr(), c.rotations.as_ptr(), c.sh.as_ptr(), c.sh.capacity());
        let taken = places(&planned);
        let mut model = one(1.0, 1);
        model.extend(&one(2.0, 1));
        planned.clone_from(&model);
        assert_eq!((places(&planned), &planned), (taken, &model));
    }

    #[test]
    fn a_lower_degree_is_the_head_of_every_row() {
        let mut a = one(1.0, 2);
        a.extend(&one(2.0, 2));
        a.sh.iter_mut().enumerate().for_each(|(i, v)| *v = i as f32);
        a.lower_sh_degree(1);
        let head = |from: u32| (from..from + 12).map(|v| v as f32);
        assert_eq!((a.sh_degree, &a.sh), (1, &head(0).chain(head(27)).collect::<Vec<_>>()));
        a.lower_sh_degree(3);
        assert_eq!(a.sh_degree, 1, "nothing is made up");
    }

    #[test]
    fn rows_are_taken_out_and_put_back_where_they_were() {
        let mut all = one(1.0, 1);
        (2..6).for_each(|v| all.extend(&one(v as f32, 1)));
        let mut part = all.rows(&[3, 1]);
        assert_eq!(part.means, vec![[4.0; 3], [2.0; 3]]);
        assert_eq!(part.sh[..12], [4.0; 12]);
        part.extend(&one(7.0, 0));
        let before = all.clone();
        all.set_row(0, &part, 1);
        all.set_row(4, &one(9.0, 0), 0);
        assert_eq!((all.means[0], all.opacity_logits[0], all.sh[..12].to_vec()), ([2.0; 3], 2.0, vec![2.0; 12]));
        assert_eq!(all.sh[48..], [9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!((&all.means[1..4], &all.sh[12..48]), (&before.means[1..4], &before.sh[12..48]));
    }

    #[test]
    fn rows_with_nan_or_zero_quaternion_are_dropped_and_counted() {
        let mut a = one(1.0, 0);
        a.extend(&one(f32::NAN, 0));
        a.extend(&one(2.0, 0));
        a.rotations[2] = [0.0; 4];
        a.extend(&one(3.0, 0));
        assert_eq!(a.drop_invalid(), 2);
        assert_eq!(a.means, vec![[1.0; 3], [3.0; 3]]);
    }
}
