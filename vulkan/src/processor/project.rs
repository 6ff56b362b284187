//! Stages *project* and *shade*: which Gaussians are seen, where, and in which colour (`shaders/project.comp`, `catch_up.comp`,
//! `shade.comp`; references: `crate::reference::{project, shade}`).

use super::gaussians::{Geometry, Harmonics, Lazy, MOST, Numbers, State, Vec4, catch_up, steps_behind, uniform_hash};
use super::lanes::{F8, LANES, exp2, fma, load, log2, sigmoid, splat, store};
use super::pool::Parts;
use super::projection::{Camera, Projection, View, four, three};
use super::vectors::{V3, fetch, rows};
use super::{Call, SHARE};
use crate::constants::{ALPHA_MIN, COLOUR_MAX};
use crate::layout::{FLAG_KEEP_FAINT, FLAG_KEEP_OUTSIDE, Frame, Status};
use crate::reference::shade::basis;
use fearless_simd::prelude::*;
use fearless_simd::{Simd, dispatch};
use glam::Vec3;

/// The key of what is not seen.
pub(super) const UNSEEN: u32 = u32::MAX;

/// Section of what place each Gaussian has in depth order, [`UNSEEN`] where none: kernels that move Gaussians take them as they lie.
pub(super) const RANKS: &str = "order_other";

/// What projection leaves of a Gaussian: centre, depth and log2 of its opacity; its parabola; the edge of its ellipse.
pub(super) type Projected = [Vec4; 3];

/// Culls and projects every Gaussian, after the lazy updates that it missed outside the view. Mode 1 does those for all of them and
/// projects nothing.
pub(super) fn project(call: &Call<'_>) {
    let (frame, memory) = (call.frame, &call.memory);
    // SAFETY: the three sections that this kernel writes, once each.
    let (geometry, projected, keys) = unsafe {
        (
            Parts::of(memory.write::<Geometry>("geometry")),
            Parts::of(memory.write::<Projected>("projected")),
            Parts::of(memory.write::<u32>("keys")),
        )
    };
    let (camera, gaussians) = (Camera::of(frame), frame.gaussians as usize);
    call.pool.each(gaussians.div_ceil(SHARE), |share| {
        let (first, count) = (share * SHARE, SHARE.min(gaussians - share * SHARE));
        // SAFETY: a share of the Gaussians for each part.
        let (own, projected, keys) =
            unsafe { (geometry.range(first, count), projected.range(first, count), keys.range(first, count)) };
        dispatch!(call.level, s => {
            for (i, own) in own.chunks_mut(LANES).enumerate() {
                for own in own.iter_mut() {
                    update_geometry(frame, &camera, own, call.push.mode == 1);
                }
                if call.push.mode == 0 {
                    let (at, count) = (i * LANES, own.len());
                    let out = (&mut projected[at..at + count], &mut keys[at..at + count]);
                    project_some(s, frame, &camera, own, first + at, out);
                }
            }
        });
    });
}

/// Lazy updates of a Gaussian's geometry. Who is far behind the camera cannot have come in front of it by what little they move.
#[inline(always)]
fn update_geometry(frame: &Frame, camera: &Camera, own: &mut Geometry, all: bool) {
    let state = State::of(own[1][3]);
    let behind = steps_behind(state.geometry(), frame.step.wrapping_sub(1));
    let near_view = all || camera.depth(three(own[0])) > 0.0;
    if behind == 0 || !near_view {
        return;
    }
    let missed = &frame.deferred[behind];
    let [p0, p1, p2, m0, m1, m2, v0, v1, v2] = own;
    let (mean, unit) = (missed.mean, missed.unit);
    catch_up(p0, m0, v0, &[mean, mean, mean, unit * frame.opacity_rate], missed);
    let scales = unit * frame.log_scale_rate;
    catch_up(p1, m1, v1, &[scales, scales, scales, 0.0], missed);
    catch_up(p2, m2, v2, &[unit * frame.rotation_rate; 4], missed);
    p1[3] = State::new(frame.step.wrapping_sub(1), state.sh(), state.degree()).word();
}

/// Where up to eight Gaussians are seen; [`UNSEEN`] for those that are not. Comparisons with what is not a number are false: that is
/// never seen.
#[inline(always)]
fn project_some<S: Simd>(
    s: S,
    frame: &Frame,
    camera: &Camera,
    own: &[Geometry],
    first: usize,
    (projected, keys): (&mut [Projected], &mut [u32]),
) {
    /// Depths beyond this are no places.
    const FARTHEST: f32 = 1.0e30;
    /// Centres beyond this are no places in a picture, pixels.
    const WIDEST: f32 = 1.0e9;
    /// So much more than exact, pixels, that rounding never drops one that the blend would take.
    const MARGIN: f32 = 0.01;
    keys.fill(UNSEEN);
    // What does not fill the lanes is the last one again.
    let of = |lane: usize| &own[lane.min(own.len() - 1)];
    let place = fetch(s, |lane| of(lane)[0]);
    let z = View::of(s, camera).point(V3::of(place)).z;
    let near = z.simd_ge(splat(s, frame.near)) & z.simd_lt(splat(s, FARTHEST));
    let drop = frame.drop_share;
    let opacity = sigmoid(place[3]) / splat(s, 1.0 - drop);
    let faintest = if frame.has(FLAG_KEEP_FAINT) { 1.0e-30 } else { ALPHA_MIN };
    let near = near & opacity.simd_ge(splat(s, faintest));
    if !near.any_true() {
        return;
    }
    let p = Projection::of(s, camera, place, fetch(s, |lane| of(lane)[1]), fetch(s, |lane| of(lane)[2]));
    let x = p.p.x / p.divisor * camera.focal.x + splat(s, camera.principal.x);
    let y = p.p.y / p.divisor * camera.focal.y + splat(s, camera.principal.y);
    let log2_opacity = log2(opacity);
    // Inside the ellipse d'Kd <= reach the Gaussian's alpha is at least ALPHA_MIN.
    let reach = (log2_opacity - splat(s, ALPHA_MIN.log2())) * (2.0 * std::f32::consts::LN_2);
    let reach = reach.max(splat(s, 0.0));
    let (wide, high) = ((reach * p.cov[0]).sqrt() + splat(s, MARGIN), (reach * p.cov[2]).sqrt() + splat(s, MARGIN));
    let [right, bottom] = [frame.size[0] as f32 - 0.5, frame.size[1] as f32 - 0.5];
    let begins = (x - wide).simd_le(splat(s, right)) & (y - high).simd_le(splat(s, bottom));
    let inside = begins & (x + wide).simd_ge(splat(s, 0.5)) & (y + high).simd_ge(splat(s, 0.5));
    let seen = if frame.has(FLAG_KEEP_OUTSIDE) {
        let widest = splat(s, WIDEST);
        near & (inside | (x.abs().simd_lt(widest) & y.abs().simd_lt(widest)))
    } else {
        near & inside
    };
    let conic = p.conic(s);
    let down = conic[2] * (-0.5 * std::f32::consts::LOG2_E);
    let across = conic[0] * (-0.5 * std::f32::consts::LOG2_E);
    let parabola = [across, conic[1] * -std::f32::consts::LOG2_E, down, exp2(down * 2.0)];
    // Right edge of the ellipse at height dy: slope * dy + width * sqrt(half_size.y^2 - dy^2), widest at dy = tip.
    let edge = [p.cov[1] / p.cov[2], p.det.sqrt() / p.cov[2], high, p.cov[1] / p.cov[0] * wide];
    let (centers, parabolas, edges) = (rows([x, y, z, log2_opacity]), rows(parabola), rows(edge));
    let seen = seen.to_bitmask();
    for (lane, (out, key)) in projected.iter_mut().zip(keys).enumerate() {
        let dropped = drop > 0.0 && uniform_hash(frame, (first + lane) as u32, 7) < drop;
        if seen >> lane & 1 == 1 && !dropped {
            *key = centers[lane][2].to_bits();
            *out = [centers[lane], parabolas[lane], edges[lane]];
        }
    }
}

/// Lazy updates of SH that the visible Gaussians missed outside the view; mode 1: those of all.
pub(super) fn catch_up_sh(call: &Call<'_>) {
    let (frame, memory) = (call.frame, &call.memory);
    let keys = memory.read::<u32>("keys");
    // SAFETY: the sections that this kernel writes, once each.
    let (geometry, harmonics) = unsafe { (Parts::of(memory.write::<Geometry>("geometry")), call.harmonics()) };
    let gaussians = frame.gaussians as usize;
    call.pool.each(gaussians.div_ceil(SHARE), |share| {
        let (first, count) = (share * SHARE, SHARE.min(gaussians - share * SHARE));
        // SAFETY: a share of the Gaussians for each part.
        let own = unsafe { geometry.range(first, count) };
        dispatch!(call.level, s => {
            for (g, own) in (first..).zip(own) {
                if call.push.mode == 1 || keys[g] != UNSEEN {
                    update_sh(s, call, &harmonics, own, g);
                }
            }
        });
    });
}

#[inline(always)]
fn update_sh<S: Simd>(s: S, call: &Call<'_>, harmonics: &Harmonics<'_>, own: &mut Geometry, g: usize) {
    let (frame, state) = (call.frame, State::of(own[1][3]));
    let behind = steps_behind(state.sh(), frame.step.wrapping_sub(1));
    if behind == 0 {
        return;
    }
    let missed = &frame.deferred[behind];
    own[1][3] = State::new(state.geometry(), frame.step.wrapping_sub(1), state.degree()).word();
    let (at, held) = (g * harmonics.stride, call.held(state));
    let steps = rates_of(frame, missed.unit);
    let missed = Lazy::of(s, missed);
    for (i, steps) in (0..held).step_by(LANES).zip(steps.chunks_exact(LANES)) {
        let count = LANES.min(held - i);
        // SAFETY: numbers of this part's Gaussian.
        unsafe {
            let own = harmonics.sh.range(at + i, count);
            let moments = harmonics.moments.fetch(s, frame, at + i, count);
            let (p, moments) = missed.catch_up(load(s, own), moments, F8::from_slice(s, steps));
            store(p, own);
            harmonics.moments.store(frame, at + i, count, moments);
        }
    }
}

/// Learning rates of a Gaussian's SH times a factor: the first three are those of degree 0.
#[inline(always)]
pub(super) fn rates_of(frame: &Frame, factor: f32) -> Numbers {
    let mut rates = [factor * frame.sh_rest_rate; MOST];
    rates[..3].fill(factor * frame.sh_dc_rate);
    rates
}

/// Gathers the visible Gaussians in depth order and evaluates their colours, each at its own SH degree. It takes them as they lie:
/// they are much larger than what is left of them.
pub(super) fn shade(call: &Call<'_>) {
    let (frame, memory) = (call.frame, &call.memory);
    let (order, status) = (memory.read::<u32>("order"), &memory.read::<Status>("status")[0]);
    let (projected, geometry) = (memory.read::<Projected>("projected"), memory.read::<Geometry>("geometry"));
    let sh = memory.read::<f32>("sh");
    // SAFETY: the two sections that this kernel writes, once each; it reads the second only when that is written. The second has the sort's rows no more.
    let (shaded, ranks) = unsafe { (Parts::of(memory.write::<[Vec4; 3]>("shaded")), memory.write::<u32>(RANKS)) };
    let ranks = &mut ranks[..frame.gaussians as usize];
    ranks.fill(UNSEEN);
    let (places, visible) = (Parts::of(ranks), status.visible as usize);
    call.pool.each(visible.div_ceil(SHARE), |share| {
        let first = share * SHARE;
        for (r, g) in (first..).zip(&order[first..(first + SHARE).min(visible)]) {
            // SAFETY: every visible Gaussian is once in the order.
            unsafe { places.range(*g as usize, 1) }.fill(r as u32);
        }
    });
    let (ranks, camera, stride) = (memory.read::<u32>(RANKS), Camera::of(frame), 4 * call.columns());
    call.pool.each(call.shares(), |share| {
        dispatch!(call.level, s => {
            for (g, r) in seen(ranks, call.share(share)) {
                let state = State::of(geometry[g][1][3]);
                // An orthographic view looks along its axis everywhere.
                let direction = if camera.orthographic { camera.axis() } else { three(geometry[g][0]) - camera.center };
                let own = &sh[g * stride..g * stride + call.held(state)];
                let color = color_of(s, own, call.degree(state), direction.normalize().to_array());
                // SAFETY: every visible Gaussian has a place of its own in depth order.
                let out = unsafe { &mut shaded.range(r, 1)[0] };
                *out = [projected[g][0], projected[g][1], four(Vec3::from_array(color.map(bounded)), 0.0)];
            }
        });
    });
}

/// The visible ones of some Gaussians, as they lie, each with its place in depth order.
pub(super) fn seen(ranks: &[u32], those: std::ops::Range<usize>) -> impl Iterator<Item = (usize, usize)> {
    ranks[those.clone()].iter().zip(those).filter(|(r, _)| **r != UNSEEN).map(|(r, g)| (g, *r as usize))
}

/// A colour's number that can be shown; black where it is no number.
#[inline(always)]
fn bounded(v: f32) -> f32 {
    if v > 0.0 { v.min(COLOUR_MAX) } else { 0.0 }
}

/// The colour that coefficients show in a direction.
#[inline(always)]
fn color_of<S: Simd>(s: S, coefficients: &[f32], degree: u32, direction: [f32; 3]) -> [f32; 3] {
    /// After so many numbers the channels are again those of the lanes.
    const PERIOD: usize = 3 * LANES;
    let weights = channels_of(&basis(degree as u8, direction), [1.0; 3]);
    let mut sums = [splat(s, 0.0); 3];
    for (all, weights) in coefficients.chunks(PERIOD).zip(weights.chunks(PERIOD)) {
        for ((sum, some), weights) in sums.iter_mut().zip(all.chunks(LANES)).zip(weights.chunks(LANES)) {
            *sum = fma(load(s, some), load(s, weights), *sum);
        }
    }
    let mut lanes = [0.0; PERIOD];
    for (sum, lanes) in sums.iter().zip(lanes.chunks_exact_mut(LANES)) {
        sum.store_slice(lanes);
    }
    let mut color = [0.5; 3];
    for of_one in lanes.chunks_exact(3) {
        for c in 0..3 {
            color[c] += of_one[c];
        }
    }
    color
}

/// What each coefficient has of a basis function, as they lie: three channels of one after the other.
#[inline(always)]
pub(super) fn channels_of(basis: &[f32; 16], channels: [f32; 3]) -> Numbers {
    let mut all = [0.0; MOST];
    for (all, basis) in all.chunks_exact_mut(3).zip(basis) {
        for c in 0..3 {
            all[c] = basis * channels[c];
        }
    }
    all
}
