//! Values that a scene can have. A flipped bit of memory makes a Gaussian cover the picture or outshine it; what cannot be honest becomes
//! what the Gaussian's other values say.

use super::{GaussianCloud, SH_C0};

/// Means by which the scene's size is judged, evenly out of all.
const SAMPLE: usize = 4096;
/// Of fewer Gaussians nobody can say how large their scene is.
const LEAST: usize = 64;
/// Share of the means that lie in the scene: flipped bits put others anywhere.
const WITHIN: f64 = 0.99;
/// Log scales that are no zero and nearer to it are an exponent's lost bit: no step of training is so small, 2⁻⁶⁰.
const NO_STEP: f32 = 8.673_617e-19;
/// Opacities at this logit differ from 0 and 1 by less than f32 can say of 1.
const LOGIT: f32 = 30.0;
/// Degree 0 of a colour from -4 to 5, where pictures have 0 to 1.
const CONSTANT: f32 = 4.5 / SH_C0;
/// A coefficient of a higher degree that changes a colour by several times its range.
const DIRECTIONAL: f32 = 8.0;

/// What values a scene's Gaussians can have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plausible {
    /// Median of the means.
    middle: [f64; 3],
    /// Logarithm of twice the scene's diameter: nothing in it is longer. Trained scenes (19 models of two cards and three data sets, 500 to
    /// 500,000 Gaussians) reach 0.6 of the diameter.
    longest: f32,
}

impl Plausible {
    /// Of a scene whose Gaussians have these means, or of every so many of them.
    pub fn of(means: &[[f32; 3]]) -> Self {
        let sampled = || means.iter().step_by(means.len().div_ceil(SAMPLE).max(1));
        let unknown = Self { middle: [0.0; 3], longest: f32::INFINITY };
        if means.len() < LEAST {
            return unknown;
        }
        let mut values = Vec::with_capacity(SAMPLE);
        let mut at = |share: f64, value: &dyn Fn(&[f32; 3]) -> f64| {
            values.clear();
            values.extend(sampled().map(value).filter(|v| v.is_finite()));
            let last = values.len().checked_sub(1)?;
            Some(*values.select_nth_unstable_by((share * last as f64) as usize, f64::total_cmp).1)
        };
        let [Some(x), Some(y), Some(z)] = [0, 1, 2].map(|k| at(0.5, &|mean| f64::from(mean[k]))) else {
            return unknown;
        };
        let middle = [x, y, z];
        match at(WITHIN, &|mean| distance(middle, mean)) {
            Some(radius) if radius > 0.0 => Self { middle, longest: (4.0 * radius).ln() as f32 },
            _ => unknown,
        }
    }

    /// Gives plausible values to those of `cloud` that are not; how many there were. Numbers that are not finite stay: their Gaussians are
    /// dropped by who reads them.
    pub fn mend(&self, cloud: &mut GaussianCloud) -> usize {
        let stride = cloud.sh_stride();
        let places = cloud.means.iter().zip(&mut cloud.log_scales);
        let mut mended: usize = places.map(|(mean, scales)| self.mend_scales(mean, scales)).sum();
        for logit in cloud.opacity_logits.iter_mut().filter(|l| l.is_finite() && l.abs() > LOGIT) {
            *logit = LOGIT.copysign(*logit);
            mended += 1;
        }
        for sh in cloud.sh.chunks_exact_mut(stride) {
            let (constant, directional) = sh.split_at_mut(3);
            mended += mend_constant(constant);
            for value in directional.iter_mut().filter(|v| v.is_finite() && v.abs() > DIRECTIONAL) {
                *value = 0.0;
                mended += 1;
            }
        }
        mended
    }

    /// An axis that cannot be so long is as long as the longest of the others; where all are too long, as long as can be.
    fn mend_scales(&self, mean: &[f32; 3], scales: &mut [f32; 3]) -> usize {
        let is_lost = |s: f32| s != 0.0 && s.abs() < NO_STEP;
        if !scales.iter().any(|s| s.is_finite() && (*s > self.longest || is_lost(*s))) {
            return 0;
        }
        // A sky is as large as it is far away.
        let longest = self.longest.max(distance(self.middle, mean).ln() as f32);
        let is_bad = |s: f32| s.is_finite() && (s > longest || is_lost(s));
        let sound = scales.iter().copied().filter(|s| s.is_finite() && !is_bad(*s)).reduce(f32::max);
        let bad = scales.iter_mut().filter(|s| is_bad(**s));
        bad.map(|s| *s = sound.unwrap_or(if is_lost(*s) { 0.0 } else { longest })).count()
    }
}

fn distance(middle: [f64; 3], mean: &[f32; 3]) -> f64 {
    middle.iter().zip(mean).map(|(middle, v)| (f64::from(*v) - middle).powi(2)).sum::<f64>().sqrt()
}

/// A colour's channel that cannot be is as bright as the others.
fn mend_constant(channels: &mut [f32]) -> usize {
    let is_bad = |v: f32| v.is_finite() && v.abs() > CONSTANT;
    if !channels.iter().any(|v| is_bad(*v)) {
        return 0;
    }
    let (mut sum, mut count) = (0.0, 0.0);
    for v in channels.iter().filter(|v| v.is_finite() && !is_bad(**v)) {
        (sum, count) = (sum + v, count + 1.0);
    }
    let instead = if count > 0.0 { sum / count } else { 0.0 };
    let bad = channels.iter_mut().filter(|v| is_bad(**v));
    bad.map(|v| *v = instead).count()
}
