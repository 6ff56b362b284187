//! Stages *reduce* and *optimise*: a Gaussian's summed gradient, projection's gradient, and Adam (`shaders/reduce.comp`, `optimise_sh.comp`,
//! `project_backward.comp`, `pose_sums.comp`, `optimise.comp`; references: `crate::reference::{project_backward, adam}`).

use super::gaussians::{Geometry, Harmonics, MOST, Numbers, State, Vec4, adam, finite, sigmoid, uniform_hash};
use super::pool::Parts;
use super::project::{RANKS, UNSEEN, channels_of, rates_of};
use super::projection::{Camera, Projection, four, length, three};
use super::{Call, SHARE};
use crate::constants::{COLOUR_MAX, SH_SMALL};
use crate::layout::{FLAG_DEPTH, Frame, PoseSums, Status};
use crate::reference::shade::{basis, basis_gradient};
use fearless_simd::dispatch;
use glam::{BVec3, Mat2, Vec2, Vec3};

/// A Gaussian's summed slots: q and its first moments and the total weight, second moments and depth, colour. Then, in the third, what its
/// place gains by the colour.
type Reduced = [Vec4; 3];

/// Gradients in the camera's axes: point and logarithm of the opacity; log scales; turn.
type Gradients = [Vec4; 3];

/// Number of visible Gaussians.
fn visible(call: &Call<'_>) -> usize {
    call.memory.read::<Status>("status")[0].visible as usize
}

/// The visible ones of some Gaussians, as they lie, each with its place in depth order.
fn seen(ranks: &[u32], those: std::ops::Range<usize>) -> impl Iterator<Item = (usize, usize)> {
    ranks[those.clone()].iter().zip(those).filter(|(r, _)| **r != UNSEEN).map(|(r, g)| (g, *r as usize))
}

/// The Gaussians of a share.
fn share_of(call: &Call<'_>, share: usize) -> std::ops::Range<usize> {
    share * SHARE..((share + 1) * SHARE).min(call.frame.gaussians as usize)
}

/// Shares of all Gaussians.
fn shares(call: &Call<'_>) -> usize {
    (call.frame.gaussians as usize).div_ceil(SHARE)
}

/// Sums each visible Gaussian's gradient slots in tile order. Mode 1 adds to the sum of earlier bands: one running sum either way, so that
/// the number of bands does not change a bit.
pub(super) fn reduce(call: &Call<'_>) {
    let memory = &call.memory;
    let (ranges, slots) = (memory.read::<[u32; 2]>("slot_ranges"), memory.read::<Reduced>("slots"));
    let shaded = memory.read::<[Vec4; 3]>("shaded");
    // SAFETY: the only section that this kernel writes.
    let reduced = Parts::of(unsafe { memory.write::<Reduced>("reduced") });
    let (n, has_depth, adds) = (visible(call), call.frame.has(FLAG_DEPTH), call.push.mode == 1);
    call.pool.each(n.div_ceil(SHARE), |share| {
        let (first, count) = (share * SHARE, SHARE.min(n - share * SHARE));
        // SAFETY: a share of the visible Gaussians for each part.
        let out = unsafe { reduced.range(first, count) };
        dispatch!(call.level, _s => {
            for (r, out) in (first..).zip(out) {
                let [start, slot_count] = ranges[r].map(|n| n as usize);
                let before = if adds { *out } else { [[0.0; 4]; 3] };
                *out = sum_of(&slots[start..start + slot_count], before, has_depth);
                // Where the colour was clamped there is no gradient.
                for c in 0..3 {
                    let clamped = shaded[r][2][c] <= 0.0 || shaded[r][2][c] >= COLOUR_MAX;
                    out[2][c] = if clamped { 0.0 } else { out[2][c] };
                }
            }
        });
    });
}

/// Adds slots to a sum. A slot holds a depth gradient only where the view has a depth prior, and but its first vector only where it has a
/// weight.
#[inline(always)]
fn sum_of(slots: &[Reduced], mut sum: Reduced, has_depth: bool) -> Reduced {
    for [line, square, color] in slots {
        for c in 0..4 {
            sum[0][c] += line[c];
        }
        if line[3] > 0.0 {
            for c in 0..4 {
                sum[1][c] += if c < 3 || has_depth { square[c] } else { 0.0 };
                sum[2][c] += if c < 3 { color[c] } else { 0.0 };
            }
        }
    }
    sum
}

/// From the gradient of a Gaussian's colour to its SH, and Adam in the same breath. What its place gains from it is left where the colour's
/// gradient was. Mode 1 writes the gradient to where the first moment is and changes nothing else.
pub(super) fn optimise_sh(call: &Call<'_>) {
    let memory = &call.memory;
    let (ranks, geometry) = (memory.read::<u32>(RANKS), memory.read::<Geometry>("geometry"));
    // SAFETY: the sections that this kernel writes, once each.
    let (reduced, harmonics) = unsafe { (Parts::of(memory.write::<Reduced>("reduced")), call.harmonics()) };
    let (camera, rates) = (Camera::of(call.frame), rates_of(call.frame, 1.0));
    call.pool.each(shares(call), |share| {
        dispatch!(call.level, _s => {
            for (g, r) in seen(ranks, share_of(call, share)) {
                // SAFETY: every Gaussian has a place of its own.
                let own = unsafe { &mut reduced.range(r, 1)[0] };
                own[2] = step_sh(call, (&harmonics, &rates), &camera, g, &geometry[g], own[2]);
            }
        });
    });
}

/// Steps a Gaussian's SH; returns the gradient by its place, and whether the colour's was finite.
#[inline(always)]
fn step_sh(
    call: &Call<'_>,
    (harmonics, rates): (&Harmonics<'_>, &Numbers),
    camera: &Camera,
    g: usize,
    geometry: &Geometry,
    by_color: Vec4,
) -> Vec4 {
    let (frame, state) = (call.frame, State::of(geometry[1][3]));
    // The basis functions of a direction are finite and at most 1.5.
    let mut all_finite = true;
    let by_color = finite([by_color[0], by_color[1], by_color[2], 0.0], &mut all_finite);
    let away = three(geometry[0]) - camera.center;
    let distance = away.length().max(1.0e-12);
    let direction = away / distance;
    let degree = call.degree(state) as u8;
    let mut gradient = channels_of(&basis(degree, direction.to_array()), [by_color[0], by_color[1], by_color[2]]);
    let (at, held) = (g * harmonics.stride, call.held(state));
    let mut before = [0.0; MOST];
    // SAFETY: numbers of this part's Gaussian.
    let own = unsafe { harmonics.sh.range(at, held) };
    before[..held].copy_from_slice(own);
    // The derivative of what coefficients above degree 0 amount to. Where a picture has no gradient they count for nothing: it does not
    // show the Gaussian, or not yet that degree.
    for i in 3..MOST {
        let more = frame.sh_weight * before[i] / (before[i].abs() + SH_SMALL);
        gradient[i] += if gradient[i] == 0.0 { 0.0 } else { more };
    }
    // SAFETY: as above.
    unsafe {
        if call.push.mode == 1 {
            harmonics.moments.store(frame, at, held, [gradient, gradient.map(|g| g * g)]);
        } else {
            let mut p = before;
            let [mut m, mut v] = harmonics.moments.fetch(frame, at, held);
            adam(frame, &mut p, &mut m, &mut v, &gradient, rates);
            own.copy_from_slice(&p[..held]);
            harmonics.moments.store(frame, at, held, [m, v]);
        }
    }
    let mut weights = [0.0; 16];
    for (weight, of_one) in weights.iter_mut().zip(before.chunks_exact(3)) {
        *weight = by_color[0] * of_one[0] + by_color[1] * of_one[1] + by_color[2] * of_one[2];
    }
    let by_direction = Vec3::from_array(basis_gradient(degree, direction.to_array(), &weights));
    let place = (by_direction - direction * direction.dot(by_direction)) / distance;
    four(place, if all_finite { 0.0 } else { 1.0 })
}

/// The gradient of one scaled axis in the camera's axes.
#[inline(always)]
fn axis_gradient(f: Vec2, ratio: Vec2, ga: f32, gb: f32) -> Vec3 {
    let (x, y) = (f.x * ga, f.y * gb);
    Vec3::new(x, y, -ratio.x * x - ratio.y * y)
}

/// The Gaussians of one of the lanes that leave partial sums.
fn lane_of(call: &Call<'_>, lane: usize) -> std::ops::Range<usize> {
    let n = call.frame.gaussians as usize;
    let share = n.div_ceil(call.loop_lanes());
    (lane * share).min(n)..((lane + 1) * share).min(n)
}

/// From a Gaussian's summed gradient in the picture to that of its point, scales and turn in the camera's axes, through projection; it
/// lies where the projections did, by place in depth order.
pub(super) fn project_backward(call: &Call<'_>) {
    let memory = &call.memory;
    let (ranks, geometry) = (memory.read::<u32>(RANKS), memory.read::<Geometry>("geometry"));
    let reduced = memory.read::<Reduced>("reduced");
    // SAFETY: the two sections that this kernel writes, once each.
    let (gradients, sums) = unsafe {
        (Parts::of(memory.write::<Gradients>("projected")), Parts::of(memory.write::<PoseSums>("lane_sums")))
    };
    let camera = Camera::of(call.frame);
    call.pool.each(call.loop_lanes(), |lane| {
        // SAFETY: a lane's own sum.
        let sums = unsafe { &mut sums.range(lane, 1)[0] };
        sums.non_finite = 0;
        dispatch!(call.level, _s => {
            for (g, r) in seen(ranks, lane_of(call, lane)) {
                // SAFETY: every Gaussian has a place of its own.
                let out = unsafe { &mut gradients.range(r, 1)[0] };
                let all_finite = project_back(&camera, &geometry[g], &reduced[r], out);
                sums.non_finite += u32::from(!all_finite);
            }
        });
    });
}

/// Whether all was finite.
#[inline(always)]
fn project_back(camera: &Camera, geometry: &Geometry, reduced: &Reduced, out: &mut Gradients) -> bool {
    let s = Projection::of(camera, geometry[0], geometry[1], geometry[2]);
    let inverse_z = 1.0 / s.p.z;
    let conic = s.conic();
    let f = camera.focal * inverse_z;
    let mut all_finite = true;

    // Covariance: dL/dM = K S K M for the projected axes M = (a, b).
    let [line, square, by_color] = reduced;
    let symmetric = |xx: f32, xy: f32, yy: f32| Mat2::from_cols(Vec2::new(xx, xy), Vec2::new(xy, yy));
    let k = symmetric(conic[0], conic[1], conic[2]);
    let ksk = k * symmetric(square[0], square[1], square[2]) * k;
    let (xx, xy, yy) = (ksk.x_axis.x, ksk.x_axis.y, ksk.y_axis.y);
    let (ga, gb) = (xx * s.a + xy * s.b, xy * s.a + yy * s.b);
    let az = Vec3::new(s.axes[0].z, s.axes[1].z, s.axes[2].z);
    let ratio = Vec2::select(s.clamped, Vec2::ZERO, -f * Vec2::new(ga.dot(az), gb.dot(az)));
    let place = Vec2::new(s.p.x, s.p.y);
    let nearer = ratio.dot(place * inverse_z) + ga.dot(s.a) + gb.dot(s.b);

    // Place in the picture, then the point in the camera's axes.
    let screen = Vec2::new(conic[0] * line[1] + conic[1] * line[2], conic[1] * line[1] + conic[2] * line[2]);
    let across = screen * f + ratio * inverse_z;
    let depth = square[3] - ((screen * f).dot(place) + nearer) * inverse_z;
    out[0] = finite([across.x, across.y, depth, line[0]], &mut all_finite);

    // The axes turned together and stretched each: no gradient of a rotation matrix is needed.
    let by_axis = [0, 1, 2].map(|i| axis_gradient(f, s.ratio, ga[i], gb[i]));
    let turn = s.axes[0].cross(by_axis[0]) + s.axes[1].cross(by_axis[1]) + s.axes[2].cross(by_axis[2]);
    let stretch = Vec3::new(s.axes[0].dot(by_axis[0]), s.axes[1].dot(by_axis[1]), s.axes[2].dot(by_axis[2]));
    let clamped: BVec3 = s.scale_clamped;
    out[1] = finite(four(Vec3::select(clamped, Vec3::ZERO, stretch), 0.0), &mut all_finite);
    // What `optimise` makes of it for a quaternion that is nearly nothing is as long as that is short.
    finite(four(turn * (2.0 / s.q_length), 0.0), &mut all_finite);
    out[2] = finite(four(turn, 0.0), &mut all_finite);

    let by_color = finite(*by_color, &mut all_finite);
    all_finite && by_color[3] == 0.0
}

/// The gradient of the camera's pose, p' = exp(turn) p + shift, one partial sum per lane.
pub(super) fn pose_sums(call: &Call<'_>) {
    let memory = &call.memory;
    let (ranks, geometry) = (memory.read::<u32>(RANKS), memory.read::<Geometry>("geometry"));
    let (gradients, reduced) = (memory.read::<Gradients>("projected"), memory.read::<Reduced>("reduced"));
    // SAFETY: the only section that this kernel writes.
    let sums = Parts::of(unsafe { memory.write::<PoseSums>("lane_sums") });
    let camera = Camera::of(call.frame);
    call.pool.each(call.loop_lanes(), |lane| {
        let (mut turn, mut shift) = (Vec3::ZERO, Vec3::ZERO);
        for (g, r) in seen(ranks, lane_of(call, lane)) {
            let p = camera.point(three(geometry[g][0]));
            let point = three(gradients[r][0]);
            turn += p.cross(point) + three(gradients[r][2]);
            // The camera sees the world move; with it moves the direction that SH are seen from.
            shift += point + camera.turned(three(reduced[r][2]));
        }
        // SAFETY: a lane's own sum.
        let own = unsafe { &mut sums.range(lane, 1)[0] };
        (own.turn, own.shift) = (turn.to_array(), shift.to_array());
    });
}

/// Adam on a Gaussian's place, opacity, scales and rotation. Mode 1 writes the gradient to where the first moment is and changes nothing
/// else.
pub(super) fn optimise(call: &Call<'_>) {
    let (frame, memory) = (call.frame, &call.memory);
    let (ranks, gradients) = (memory.read::<u32>(RANKS), memory.read::<Gradients>("projected"));
    let reduced = memory.read::<Reduced>("reduced");
    // SAFETY: the only section that this kernel writes.
    let geometry = Parts::of(unsafe { memory.write::<Geometry>("geometry") });
    let (n, camera) = (visible(call), Camera::of(frame));
    let entropy_weight = frame.entropy_weight / n.max(1) as f32;
    call.pool.each(shares(call), |share| {
        dispatch!(call.level, _s => {
            for (g, r) in seen(ranks, share_of(call, share)) {
                // SAFETY: a share of the Gaussians for each part.
                let own = unsafe { &mut geometry.range(g, 1)[0] };
                let by = to_world(&camera, own, &gradients[r], &reduced[r], entropy_weight);
                if call.push.mode == 1 {
                    own[3..6].copy_from_slice(&by);
                } else {
                    step_geometry(call, own, by, g as u32);
                }
            }
        });
    });
}

/// Gradients of a Gaussian's three rows of geometry.
#[inline(always)]
fn to_world(camera: &Camera, own: &Geometry, by: &Gradients, reduced: &Reduced, entropy_weight: f32) -> [Vec4; 3] {
    let (logit, mut told) = (own[0][3], true);
    let opacity = sigmoid(logit);
    // d/dx of the binary entropy of sigmoid(x) is -x sigmoid'(x); the mean is over those in view.
    let entropy = -entropy_weight * logit * opacity * (1.0 - opacity);
    let place = camera.in_world(three(by[0])) + three(reduced[2]);
    // A turn by t moves the quaternion q by (0, t/2) q, and what the turn's gradient gives for q is tangent to the sphere.
    let q_length = length(own[2]);
    let q = own[2].map(|v| v / q_length);
    let (real, imaginary) = (q[0], Vec3::new(q[1], q[2], q[3]));
    let t = camera.in_world(three(by[2])) * (2.0 / q_length);
    let turned = real * t + t.cross(imaginary);
    [
        finite(four(place, by[0][3] * (1.0 - opacity) + entropy), &mut told),
        by[1],
        finite([-t.dot(imaginary), turned.x, turned.y, turned.z], &mut told),
    ]
}

/// One step of Adam on a Gaussian's geometry, and noise on what is nearly transparent, so that it finds a place where it is of use (MCMC,
/// Brush's form).
#[inline(always)]
fn step_geometry(call: &Call<'_>, own: &mut Geometry, by: [Vec4; 3], g: u32) {
    let frame = call.frame;
    let opacity = sigmoid(own[0][3]);
    let state = State::of(own[1][3]);
    let (mean, scale) = (frame.mean_rate, frame.log_scale_rate);
    let rates = [[mean, mean, mean, frame.opacity_rate], [scale, scale, scale, 0.0], [frame.rotation_rate; 4]];
    let [p0, p1, p2, m0, m1, m2, v0, v1, v2] = own;
    for ((p, m, v), (by, rate)) in [(p0, m0, v0), (p1, m1, v1), (p2, m2, v2)].into_iter().zip(by.into_iter().zip(rates))
    {
        adam(frame, p, m, v, &by, &rate);
    }
    let loose = if frame.noise > 0.0 { frame.noise * (1.0 - opacity).powi(150) } else { 0.0 };
    if loose > 0.0 {
        for (i, p) in own[0][..3].iter_mut().enumerate() {
            *p += (normal_hash(frame, g, 2 * i as u32) * loose).clamp(-frame.max_noise, frame.max_noise);
        }
    }
    let degree = if call.own_degrees { state.degree() } else { call.sh_degree() };
    own[1][3] = State::new(frame.step, frame.step, degree).word();
}

/// Normal, by Box-Muller from two hashes.
fn normal_hash(frame: &Frame, gaussian: u32, channel: u32) -> f32 {
    let (u, w) = (uniform_hash(frame, gaussian, channel).max(5.0e-8), uniform_hash(frame, gaussian, channel + 1));
    (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * w).cos()
}
