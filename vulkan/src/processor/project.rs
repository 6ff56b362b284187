//! Stages *project* and *shade*: which Gaussians are seen, where, and in which colour (`shaders/project.comp`, `catch_up.comp`,
//! `shade.comp`; references: `crate::reference::{project, shade}`).

use super::gaussians::{
    Geometry, Harmonics, MOST, Numbers, State, Vec4, catch_up, sigmoid, steps_behind, uniform_hash,
};
use super::pool::Parts;
use super::projection::{Camera, Projection, four, three};
use super::{Call, SHARE};
use crate::constants::{ALPHA_MIN, COLOUR_MAX};
use crate::layout::{FLAG_KEEP_FAINT, FLAG_KEEP_OUTSIDE, Frame, Status};
use crate::reference::shade::basis;
use fearless_simd::dispatch;
use glam::{Vec2, Vec3};

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
        dispatch!(call.level, _s => {
            for (i, own) in own.iter_mut().enumerate() {
                update_geometry(frame, &camera, own, call.push.mode == 1);
                if call.push.mode == 0 {
                    let seen = project_one(frame, &camera, own, (first + i) as u32);
                    keys[i] = seen.map_or(UNSEEN, |seen| seen[0][2].to_bits());
                    if let Some(seen) = seen {
                        projected[i] = seen;
                    }
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

/// Where a Gaussian is seen; nothing where it is not. Comparisons with what is not a number are false: that is never seen.
#[inline(always)]
fn project_one(frame: &Frame, camera: &Camera, own: &Geometry, g: u32) -> Option<Projected> {
    /// Depths beyond this are no places.
    const FARTHEST: f32 = 1.0e30;
    /// Centres beyond this are no places in a picture, pixels.
    const WIDEST: f32 = 1.0e9;
    /// So much more than exact, pixels, that rounding never drops one that the blend would take.
    const MARGIN: f32 = 0.01;
    let z = camera.depth(three(own[0]));
    if !(z >= frame.near && z < FARTHEST) {
        return None;
    }
    let drop = frame.drop_share;
    let opacity = sigmoid(own[0][3]) / (1.0 - drop);
    let faintest = if frame.has(FLAG_KEEP_FAINT) { 1.0e-30 } else { ALPHA_MIN };
    let dropped = drop > 0.0 && uniform_hash(frame, g, 7) < drop;
    let is_seen = opacity >= faintest && !dropped;
    if !is_seen {
        return None;
    }
    let s = Projection::of(camera, own[0], own[1], own[2]);
    let center = Vec2::new(s.p.x, s.p.y) / s.divisor * camera.focal + camera.principal;
    let log2_opacity = opacity.log2();
    // Inside the ellipse d'Kd <= reach the Gaussian's alpha is at least ALPHA_MIN.
    let reach = 2.0 * std::f32::consts::LN_2 * (log2_opacity - ALPHA_MIN.log2());
    let half_size = Vec2::new((reach.max(0.0) * s.cov[0]).sqrt(), (reach.max(0.0) * s.cov[2]).sqrt()) + MARGIN;
    let (least, most) = (center - half_size, center + half_size);
    let size = Vec2::new(frame.size[0] as f32, frame.size[1] as f32);
    let inside = least.cmple(size - 0.5).all() && most.cmpge(Vec2::splat(0.5)).all();
    let kept = frame.has(FLAG_KEEP_OUTSIDE) && center.abs().cmplt(Vec2::splat(WIDEST)).all();
    if !(inside || kept) {
        return None;
    }
    let conic = s.conic();
    let down = -0.5 * std::f32::consts::LOG2_E * conic[2];
    let parabola =
        [-0.5 * std::f32::consts::LOG2_E * conic[0], -std::f32::consts::LOG2_E * conic[1], down, (2.0 * down).exp2()];
    // Right edge of the ellipse at height dy: slope * dy + width * sqrt(half_size.y^2 - dy^2), widest at dy = tip.
    let edge = [s.cov[1] / s.cov[2], s.det.sqrt() / s.cov[2], half_size.y, s.cov[1] / s.cov[0] * half_size.x];
    Some([[center.x, center.y, z, log2_opacity], parabola, edge])
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
        dispatch!(call.level, _s => {
            for (g, own) in (first..).zip(own) {
                if call.push.mode == 1 || keys[g] != UNSEEN {
                    update_sh(call, &harmonics, own, g);
                }
            }
        });
    });
}

#[inline(always)]
fn update_sh(call: &Call<'_>, harmonics: &Harmonics<'_>, own: &mut Geometry, g: usize) {
    let (frame, state) = (call.frame, State::of(own[1][3]));
    let behind = steps_behind(state.sh(), frame.step.wrapping_sub(1));
    if behind == 0 {
        return;
    }
    let missed = &frame.deferred[behind];
    own[1][3] = State::new(state.geometry(), frame.step.wrapping_sub(1), state.degree()).word();
    let (at, held) = (g * harmonics.stride, call.held(state));
    let steps = rates_of(frame, missed.unit);
    let mut p = [0.0; MOST];
    // SAFETY: numbers of this part's Gaussian.
    unsafe {
        let own = harmonics.sh.range(at, held);
        p[..held].copy_from_slice(own);
        let [mut m, mut v] = harmonics.moments.fetch(frame, at, held);
        catch_up(&mut p, &mut m, &mut v, &steps, missed);
        own.copy_from_slice(&p[..held]);
        harmonics.moments.store(frame, at, held, [m, v]);
    }
}

/// Learning rates of a Gaussian's SH times a factor: the first three are those of degree 0.
#[inline(always)]
pub(super) fn rates_of(frame: &Frame, factor: f32) -> Numbers {
    let mut rates = [factor * frame.sh_rest_rate; MOST];
    rates[..3].fill(factor * frame.sh_dc_rate);
    rates
}

/// Gathers the visible Gaussians in depth order and evaluates their colours, each at its own SH degree.
pub(super) fn shade(call: &Call<'_>) {
    let (frame, memory) = (call.frame, &call.memory);
    let (order, status) = (memory.read::<u32>("order"), &memory.read::<Status>("status")[0]);
    let (projected, geometry) = (memory.read::<Projected>("projected"), memory.read::<Geometry>("geometry"));
    let sh = memory.read::<f32>("sh");
    // SAFETY: the two sections that this kernel writes, once each; the second has the sort's rows no more.
    let (shaded, ranks) = unsafe { (Parts::of(memory.write::<[Vec4; 3]>("shaded")), memory.write::<u32>(RANKS)) };
    ranks[..frame.gaussians as usize].fill(UNSEEN);
    let ranks = Parts::of(ranks);
    let (camera, visible, stride) = (Camera::of(frame), status.visible as usize, 4 * call.columns());
    call.pool.each(visible.div_ceil(SHARE), |share| {
        let (first, count) = (share * SHARE, SHARE.min(visible - share * SHARE));
        // SAFETY: a share of the visible Gaussians for each part.
        let out = unsafe { shaded.range(first, count) };
        dispatch!(call.level, _s => {
            for (r, (g, out)) in (first..).zip(order[first..first + count].iter().map(|g| *g as usize).zip(out)) {
                // SAFETY: every visible Gaussian is once in the order.
                unsafe { ranks.range(g, 1) }.fill(r as u32);
                let state = State::of(geometry[g][1][3]);
                // An orthographic view looks along its axis everywhere.
                let direction = if camera.orthographic { camera.axis() } else { three(geometry[g][0]) - camera.center };
                let own = &sh[g * stride..g * stride + call.held(state)];
                let color = color_of(own, call.degree(state), direction.normalize().to_array());
                *out = [projected[g][0], projected[g][1], four(Vec3::from_array(color.map(bounded)), 0.0)];
            }
        });
    });
}

/// A colour's number that can be shown; black where it is no number.
#[inline(always)]
fn bounded(v: f32) -> f32 {
    if v > 0.0 { v.min(COLOUR_MAX) } else { 0.0 }
}

/// The colour that coefficients show in a direction.
#[inline(always)]
fn color_of(coefficients: &[f32], degree: u32, direction: [f32; 3]) -> [f32; 3] {
    let weights = channels_of(&basis(degree as u8, direction), [1.0; 3]);
    let mut products = [0.0; MOST];
    for ((product, c), weight) in products.iter_mut().zip(coefficients).zip(&weights) {
        *product = c * weight;
    }
    let mut color = [0.5; 3];
    for of_one in products.chunks_exact(3) {
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
