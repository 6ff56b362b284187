//! Scales, rotations and opacities: each rounded so that a Gaussian looks the same, and coded as what its neighbours, its size
//! class and its own other numbers do not tell.

use super::coder::{Coder, Counts, Garbled, Residuals};
use super::predict::{Linear, Neighbours, log2};

/// Log scales kept, natural: a millionth of a metre to three kilometres.
pub const LOG_SCALES: (f64, f64) = (-14.0, 8.0);
/// tan(π/8): of the 24 ways to name a Gaussian's axes one has no component of its Rodrigues vector beyond.
const WIDEST: f64 = 0.414_213_56;
/// Differences of log scales below which a rotation between the two axes is coded so many powers of two coarser than the
/// base: 2^e is about 1.5 × 0.7 / sinh(0.7 d), how little such a rotation shows.
const COARSER: [(f64, i32); 5] = [(0.2637, 3), (0.5189, 2), (0.9826, 1), (1.6924, 0), (2.584, -1)];
/// As much finer for the longest ones.
const FINEST: i32 = -2;
/// Contexts of opacities: by the neighbours', by size.
const BY_OPACITY: usize = 8;
const BY_SIZE: i32 = 3;

/// How finely shapes are rounded.
#[derive(Clone, Copy, Debug)]
pub struct ShapeSteps {
    /// Of a log scale, natural.
    pub log_scale: f64,
    /// Bits of a component of the Rodrigues vector.
    pub rotation_bits: u32,
    /// Bits of an opacity.
    pub opacity_bits: u32,
}

/// Steps of the log scales.
pub type Scales = [i32; 3];

impl ShapeSteps {
    pub fn code(self, coder: &mut impl Coder) -> Result<Self, Garbled> {
        let log_scale = f64::from(coder.f32(self.log_scale as f32)?);
        let rotation_bits = coder.bits(4, self.rotation_bits.into())? as u32;
        let opacity_bits = coder.bits(4, self.opacity_bits.into())? as u32;
        let sound = (1e-3..=8.0).contains(&log_scale) && (1..=15).contains(&rotation_bits) && opacity_bits >= 1;
        if sound { Ok(Self { log_scale, rotation_bits, opacity_bits }) } else { Err(Garbled) }
    }

    pub fn round_scales(&self, log_scales: [f32; 3]) -> Scales {
        let (low, high) = LOG_SCALES;
        log_scales.map(|v| (f64::from(v).clamp(low, high) / self.log_scale).round() as i32)
    }

    pub fn log_scales(&self, steps: Scales) -> [f32; 3] {
        steps.map(|v| (f64::from(v) * self.log_scale) as f32)
    }

    pub fn round_opacity(&self, logit: f32) -> u32 {
        let levels = f64::from(1u32 << self.opacity_bits);
        let opacity = 1.0 / (1.0 + (-f64::from(logit)).exp());
        (opacity * levels).min(levels - 1.0) as u32
    }

    pub fn opacity_logit(&self, step: u32) -> f32 {
        let opacity = (f64::from(step) + 0.5) / f64::from(1u32 << self.opacity_bits);
        (opacity / (1.0 - opacity)).ln() as f32
    }

    /// Binary logarithm of opacity times the area of the two larger axes, up to a constant: how much a Gaussian is seen.
    pub fn importance(&self, scales: Scales, opacity: u32) -> f64 {
        let [a, b, c] = scales;
        let larger = a + b + c - a.min(b).min(c);
        log2(f64::from(2 * opacity + 1)) + f64::from(larger) * self.log_scale * std::f64::consts::LOG2_E
    }

    /// The rounded component `axis` of a Rodrigues vector: its step, and the context that the step belongs to (0: a rotation
    /// that does not show).
    fn rotation_step(&self, scales: Scales, axis: usize) -> (f64, usize) {
        let moved = [(1, 2), (0, 2), (0, 1)][axis];
        let apart = (scales[moved.0] - scales[moved.1]).unsigned_abs();
        let apart_ln = f64::from(apart) * self.log_scale;
        let e = COARSER.iter().find(|(below, _)| apart_ln < *below).map_or(FINEST, |(_, e)| *e);
        let base = 2.0 * WIDEST / f64::from(1u32 << self.rotation_bits);
        let step = base * f64::from(1u32 << (e - FINEST)) / f64::from(1u32 << -FINEST);
        (step, if apart == 0 { 0 } else { (e - FINEST + 1) as usize })
    }
}

/// Codes the scales.
pub fn scales(
    coder: &mut impl Coder,
    neighbours: &Neighbours,
    classes: &[u8],
    given: Option<&[Scales]>,
) -> Result<Vec<Scales>, Garbled> {
    // Variables: class, the neighbours' scales, this one's later axes, and the constant.
    fn variables(class: u8, of_neighbours: [f64; 3], own: Scales, axis: usize) -> [f64; 7] {
        let known = |a: usize| if a > axis { f64::from(own[a]) } else { 0.0 };
        [f64::from(class), of_neighbours[0], of_neighbours[1], of_neighbours[2], known(1), known(2), 1.0]
    }
    let around = |i: usize, all: &[Scales]| [0, 1, 2].map(|a| neighbours.mean(i, |j| f64::from(all[j][a])));
    let mut lines: [Option<Linear<7>>; 3] = [const { None }; 3];
    for (axis, line) in lines.iter_mut().enumerate() {
        let rows = given.into_iter().flat_map(|all| {
            (0..all.len()).map(move |i| (variables(classes[i], around(i, all), all[i], axis), f64::from(all[i][axis])))
        });
        *line = Some(Linear::fit(rows).code(coder)?);
    }
    let mut residuals = Residuals::new(10, false);
    let mut out: Vec<Scales> = Vec::with_capacity(classes.len());
    for (i, class) in classes.iter().enumerate() {
        let near = around(i, &out);
        let (mut own, mut before) = ([0; 3], 0);
        for axis in [2, 1, 0] {
            let expected = lines[axis].as_ref().map_or(0.0, |l| l.at(&variables(*class, near, own, axis)));
            let whole = (expected + 0.5).floor();
            let context = 2 * before.min(4) + usize::from(expected >= whole);
            let whole = whole.clamp(-1e6, 1e6) as i32;
            let residual = residuals.code(coder, context, given.map_or(0, |all| all[i][axis] - whole))?;
            own[axis] = (whole + residual).clamp(-(1 << 16), 1 << 16);
            before += residual.unsigned_abs() as usize;
        }
        out.push(own);
    }
    Ok(out)
}

/// Codes the rotations, given as Rodrigues vectors; gives them as w x y z.
pub fn rotations(
    coder: &mut impl Coder,
    steps: &ShapeSteps,
    scales: &[Scales],
    given: Option<&[[f64; 3]]>,
) -> Result<Vec<[f32; 4]>, Garbled> {
    let mut residuals = Residuals::new(8, false);
    let mut out = Vec::with_capacity(scales.len());
    for (i, own) in scales.iter().enumerate() {
        let mut q = [1.0f64, 0.0, 0.0, 0.0];
        for axis in 0..3 {
            let (step, context) = steps.rotation_step(*own, axis);
            if context > 0 {
                let wanted = given.map_or(0, |all| (all[i][axis] / step).round() as i32);
                q[axis + 1] = f64::from(residuals.code(coder, context, wanted)?) * step;
            }
        }
        let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
        out.push(q.map(|v| (v / length) as f32));
    }
    Ok(out)
}

/// Codes the opacities.
pub fn opacities(
    coder: &mut impl Coder,
    steps: &ShapeSteps,
    neighbours: &Neighbours,
    scales: &[Scales],
    given: Option<&[u32]>,
) -> Result<Vec<u32>, Garbled> {
    let levels = 1usize << steps.opacity_bits;
    let size = |own: &Scales| f64::from(own.iter().sum::<i32>()) * steps.log_scale / 3.0;
    let middle = geometry::median(&mut scales.iter().map(size).collect::<Vec<_>>()).unwrap_or(0.0);
    let mut counts = vec![Counts::even(levels); BY_OPACITY * (2 * BY_SIZE as usize + 1)];
    let mut out: Vec<u32> = Vec::with_capacity(scales.len());
    for (i, own) in scales.iter().enumerate() {
        let expected = neighbours.mean(i, |j| f64::from(out[j])).round() as usize;
        let by_opacity = (expected * BY_OPACITY / levels).min(BY_OPACITY - 1);
        let by_size = (((size(own) - middle) / 0.5).round() as i32).clamp(-BY_SIZE, BY_SIZE) + BY_SIZE;
        let context = by_opacity * (2 * BY_SIZE as usize + 1) + by_size as usize;
        out.push(coder.symbol(&mut counts[context], given.map_or(0, |all| all[i]))?);
    }
    Ok(out)
}

/// Names the axes of a Gaussian so that its rotation is the smallest: its log scales and Rodrigues vector.
pub fn smallest_rotation(log_scales: [f32; 3], rotation: [f32; 4]) -> ([f32; 3], [f64; 3]) {
    let [w, x, y, z] = rotation.map(f64::from);
    let q = glam::DQuat::from_xyzw(x, y, z, w).normalize();
    let mut best = (f64::NEG_INFINITY, glam::DQuat::IDENTITY, glam::DQuat::IDENTITY);
    for turn in cube_rotations() {
        let turned = q * turn;
        if turned.w.abs() > best.0 + 1e-9 {
            best = (turned.w.abs(), turned, turn);
        }
    }
    let (_, turned, turn) = best;
    // Axis j of the turned frame is the axis of the old one that the turn takes it to.
    let scales = [glam::DVec3::X, glam::DVec3::Y, glam::DVec3::Z].map(|axis| {
        let old = (turn * axis).abs();
        log_scales[if old.x > 0.5 {
            0
        } else if old.y > 0.5 {
            1
        } else {
            2
        }]
    });
    (scales, [turned.x, turned.y, turned.z].map(|v| v / turned.w))
}

/// The 24 rotations of a cube.
fn cube_rotations() -> impl Iterator<Item = glam::DQuat> {
    use glam::{DQuat, DVec3};
    use std::f64::consts::FRAC_PI_2;
    let faces = [
        DQuat::IDENTITY,
        DQuat::from_axis_angle(DVec3::X, FRAC_PI_2),
        DQuat::from_axis_angle(DVec3::X, -FRAC_PI_2),
        DQuat::from_axis_angle(DVec3::X, 2.0 * FRAC_PI_2),
        DQuat::from_axis_angle(DVec3::Y, FRAC_PI_2),
        DQuat::from_axis_angle(DVec3::Y, -FRAC_PI_2),
    ];
    faces.into_iter().flat_map(|face| {
        (0..4).map(move |quarter| face * DQuat::from_axis_angle(DVec3::Z, f64::from(quarter) * FRAC_PI_2))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn covariance(log_scales: [f32; 3], q: glam::DQuat) -> glam::DMat3 {
        let r = glam::DMat3::from_quat(q);
        let s = glam::DVec3::from(log_scales.map(|v| (2.0 * f64::from(v)).exp()));
        r * glam::DMat3::from_diagonal(s) * r.transpose()
    }

    proptest! {
        #[test]
        fn other_names_for_the_axes_are_the_same_gaussian_and_a_small_rotation(
            log_scales in proptest::array::uniform3(-3.0f32..1.0),
            q in proptest::array::uniform4(-1.0f32..1.0),
        ) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f32>() > 1e-3);
            let (scales, vector) = smallest_rotation(log_scales, q);
            prop_assert!(vector.iter().all(|v| v.abs() <= WIDEST + 1e-6), "{vector:?}");
            let [x, y, z] = vector;
            let before = glam::DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into()).normalize();
            let after = glam::DQuat::from_xyzw(x, y, z, 1.0).normalize();
            let (a, b) = (covariance(log_scales, before), covariance(scales, after));
            for (a, b) in a.to_cols_array().iter().zip(b.to_cols_array()) {
                prop_assert!((a - b).abs() < 1e-4, "{a} {b}");
            }
        }
    }
}
