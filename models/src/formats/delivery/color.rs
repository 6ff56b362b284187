//! Colours: the mean over the directions that the scene was seen from, and how they vary with the view.

use super::coder::{Coder, Garbled, Residuals};
use super::predict::{Linear, Neighbours, half_power, log2};
use super::view_basis::{MOST, ViewBasis};
use crate::cloud::SH_C0;

/// r g b → luma, orange-blue, green-purple (YCoCg).
const FROM_RGB: [[f64; 3]; 3] = [[0.25, 0.5, 0.25], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]];
const TO_RGB: [[f64; 3]; 3] = [[1.0, 1.0, -1.0], [1.0, 0.0, 1.0], [1.0, -1.0, -1.0]];
/// Half powers of two that a mean colour's step may shrink and grow by where a Gaussian is seen much or little.
const MEAN_HALVES: (i32, i32) = (-2, 6);
/// Half powers of two for the step of a colour's variation.
const VARIATION_HALVES: (i32, i32) = (-4, 8);
/// Classes of the logarithm of an eigenvalue, 2^-9 to 2^2.
const BY_VALUE: (f64, f64) = (-9.0, 2.0);

/// How finely colours are rounded.
#[derive(Clone, Copy, Debug)]
pub struct ColorSteps {
    /// Of the mean's luma, of 1.
    pub luma: f64,
    /// A chroma step in luma steps.
    pub chroma: f64,
    /// Of the variation's luma, one standard deviation over the views.
    pub variation: f64,
    /// How the steps follow importance: 1 = inversely, 0 = not at all.
    pub by_importance: f64,
    /// Added before a variation's size is cut to whole steps; below 0.5 more of them become zero.
    pub rounding: f64,
}

impl ColorSteps {
    pub fn code(self, coder: &mut impl Coder) -> Result<Self, Garbled> {
        let mut number = |v: f64, low: f32, high: f32| {
            let v = coder.f32(v as f32)?;
            if (low..=high).contains(&v) { Ok(f64::from(v)) } else { Err(Garbled) }
        };
        Ok(Self {
            luma: number(self.luma, 1e-5, 10.0)?,
            chroma: number(self.chroma, 0.01, 100.0)?,
            variation: number(self.variation, 1e-5, 10.0)?,
            by_importance: number(self.by_importance, 0.0, 4.0)?,
            rounding: number(self.rounding, 0.0, 1.0)?,
        })
    }

    fn of_channel(&self, channel: usize) -> f64 {
        if channel == 0 { 1.0 } else { self.chroma }
    }

    fn halves(&self, importance: f64, (low, high): (i32, i32)) -> i32 {
        ((-self.by_importance * importance * 2.0).round() as i32).clamp(low, high)
    }
}

/// Rows of SH coefficients, r g b each, and what is coded of them.
pub struct Colors<'a> {
    pub steps: ColorSteps,
    pub basis: &'a ViewBasis,
    pub neighbours: &'a Neighbours,
    /// Binary logarithms, the median at zero.
    pub importance: &'a [f64],
}

fn mix(matrix: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    matrix.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// A Gaussian's SH coefficients above degree 0 as luma and chroma.
fn varying(sh: &[f32], n: usize) -> [[f64; 3]; MOST] {
    let mut out = [[0.0; 3]; MOST];
    for (to, from) in out[..n].iter_mut().zip(sh[3..].chunks_exact(3)) {
        *to = mix(&FROM_RGB, [0, 1, 2].map(|c| f64::from(from[c])));
    }
    out
}

impl Colors<'_> {
    /// Codes all colours; `given` holds the SH columns of the Gaussians in coding order. Gives such columns.
    pub fn code(&self, coder: &mut impl Coder, given: Option<&[f32]>) -> Result<Vec<f32>, Garbled> {
        let (n, count) = (self.basis.coefficients, self.importance.len());
        let stride = 3 * (n + 1);
        let row = |i: usize| given.map(|sh| &sh[i * stride..(i + 1) * stride]);
        let means = self.means(coder, count, |i| row(i).map(|sh| self.mean_of(sh)))?;
        let variations = self.variations(coder, count, |i| row(i).map(|sh| varying(sh, n)))?;
        let mut out = Vec::with_capacity(count * stride);
        for (i, mean) in means.iter().enumerate() {
            let own = &variations[i * n..(i + 1) * n];
            let constant: [f64; 3] = std::array::from_fn(|c| {
                let varies: f64 = (0..n).map(|k| f64::from(self.basis.mean[k]) * f64::from(own[k][c])).sum();
                mean[c] - varies
            });
            let rgb = mix(&TO_RGB, constant);
            out.extend(rgb.map(|v| ((v - 0.5) / f64::from(SH_C0)) as f32));
            for k in own {
                out.extend(mix(&TO_RGB, k.map(f64::from)).map(|v| v as f32));
            }
        }
        Ok(out)
    }

    /// The colour averaged over the views.
    fn mean_of(&self, sh: &[f32]) -> [f64; 3] {
        let n = self.basis.coefficients;
        let constant = mix(&FROM_RGB, [0, 1, 2].map(|c| f64::from(sh[c]) * f64::from(SH_C0) + 0.5));
        let own = varying(sh, n);
        std::array::from_fn(|c| constant[c] + (0..n).map(|k| f64::from(self.basis.mean[k]) * own[k][c]).sum::<f64>())
    }

    fn mean_steps(&self, i: usize) -> [f64; 3] {
        let factor = half_power(self.steps.halves(self.importance[i], MEAN_HALVES));
        [0, 1, 2].map(|c| factor * self.steps.luma * self.steps.of_channel(c))
    }

    fn means(
        &self,
        coder: &mut impl Coder,
        count: usize,
        given: impl Fn(usize) -> Option<[f64; 3]>,
    ) -> Result<Vec<[f64; 3]>, Garbled> {
        let rounded = |i: usize| {
            let steps = self.mean_steps(i);
            given(i).map(|v| std::array::from_fn(|c| (v[c] / steps[c]).round().clamp(-1e6, 1e6) * steps[c]))
        };
        let known: Option<Vec<[f64; 3]>> = (0..count).map(rounded).collect();
        let around = |i: usize, all: &[[f64; 3]]| [0, 1, 2].map(|c| self.neighbours.mean(i, |j| all[j][c]));
        // Variables: the neighbours' colour, this one's earlier channels, and the constant.
        let variables = |near: [f64; 3], own: [f64; 3], channel: usize| {
            let earlier = |c: usize| if c < channel { own[c] } else { 0.0 };
            [near[0], near[1], near[2], earlier(0), earlier(1), 1.0]
        };
        let mut lines: [Option<Linear<6>>; 3] = [const { None }; 3];
        for (channel, line) in lines.iter_mut().enumerate() {
            let rows = known.iter().flat_map(|all| {
                (0..all.len()).map(move |i| (variables(around(i, all), all[i], channel), all[i][channel]))
            });
            *line = Some(Linear::fit(rows).code(coder)?);
        }
        let mut residuals = [(); 3].map(|()| Residuals::new(7 * 4, false));
        let mut out: Vec<[f64; 3]> = Vec::with_capacity(count);
        for i in 0..count {
            let (steps, near) = (self.mean_steps(i), around(i, &out));
            let (mut own, mut before) = ([0.0; 3], 0);
            for channel in 0..3 {
                let step = steps[channel];
                let spread = self.neighbours.mean(i, |j| (out[j][channel] - near[channel]).abs()) / step;
                let context = 4 * magnitude(spread + 0.05) + before;
                let line = lines[channel].as_ref();
                let expected = line.map_or(0.0, |l| (l.at(&variables(near, own, channel)) / step).round());
                let expected = expected.clamp(-1e6, 1e6) as i32;
                let wanted = known.as_ref().map_or(0, |all| (all[i][channel] / step).round() as i32 - expected);
                let residual = residuals[channel].code(coder, context, wanted)?;
                own[channel] = f64::from(expected + residual) * step;
                before = residual.unsigned_abs().min(3) as usize;
            }
            out.push(own);
        }
        Ok(out)
    }

    /// The variation's coefficients, luma and chroma, `coefficients` for every Gaussian.
    fn variations(
        &self,
        coder: &mut impl Coder,
        count: usize,
        given: impl Fn(usize) -> Option<[[f64; 3]; MOST]>,
    ) -> Result<Vec<[f32; 3]>, Garbled> {
        let (basis, n) = (self.basis, self.basis.coefficients);
        let (low, high) = VARIATION_HALVES;
        let classes = (BY_VALUE.1 - BY_VALUE.0) as usize + 1;
        let sizes = (high - low) as usize + 1;
        let mut residuals = Residuals::new(classes * sizes * 4, true);
        let by_value: [usize; MOST] = std::array::from_fn(|j| {
            let value = f64::from(basis.values[j]).max(1e-30);
            (log2(value).round().clamp(BY_VALUE.0, BY_VALUE.1) - BY_VALUE.0) as usize
        });
        let mut out = vec![[0.0f32; 3]; count * n];
        for i in 0..count {
            let own = given(i);
            let halves = self.steps.halves(self.importance[i], VARIATION_HALVES);
            let fine = half_power(halves) * self.steps.variation;
            let mut sum = [[0.0f64; 3]; MOST];
            let mut so_far = 0;
            for j in 0..n {
                for channel in 0..3 {
                    let step = fine * self.steps.of_channel(channel) / f64::from(basis.values[j]).sqrt();
                    let wanted = own.map_or(0, |own| {
                        let z: f64 = (0..n).map(|k| f64::from(basis.vectors[k][j]) * own[k][channel]).sum();
                        let size = (z.abs() / step + self.steps.rounding).floor().min(1e6) as i32;
                        if z < 0.0 { -size } else { size }
                    });
                    let context = (by_value[j] * sizes + (halves - low) as usize) * 4 + so_far.min(3);
                    let q = residuals.code(coder, context, wanted)?;
                    so_far += q.unsigned_abs() as usize;
                    if q != 0 {
                        let z = f64::from(q) * step;
                        (0..n).for_each(|k| sum[k][channel] += f64::from(basis.vectors[k][j]) * z);
                    }
                }
            }
            for (to, from) in out[i * n..(i + 1) * n].iter_mut().zip(sum) {
                *to = from.map(|v| v as f32);
            }
        }
        Ok(out)
    }
}

/// Powers of two from 1/8 to 8 as 0 to 6.
fn magnitude(v: f64) -> usize {
    [0.25, 0.5, 1.0, 2.0, 4.0, 8.0].iter().filter(|from| v >= **from).count()
}
