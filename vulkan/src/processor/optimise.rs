//! Stages *reduce* and *optimise*: a Gaussian's summed gradient, projection's gradient, and Adam (`shaders/reduce.comp`, `optimise_sh.comp`,
//! `project_backward.comp`, `pose_sums.comp`, `optimise.comp`; references: `crate::reference::{project_backward, adam}`).

use super::gaussians::{Adam, Geometry, Harmonics, MOST, Numbers, State, Vec4, adam, finite, sigmoid, uniform_hash};
use super::lanes::{F8, LANES, load, ramp, splat, store};
use super::pool::Parts;
use super::project::{RANKS, channels_of, rates_of, seen};
use super::projection::{Camera, Projection, four, length, three};
use super::vectors::{V3, fetch, rows};
use super::{Call, SHARE};
use crate::constants::{COLOUR_MAX, SH_SMALL};
use crate::layout::{FLAG_DEPTH, Frame, PoseSums, Status};
use crate::reference::shade::{basis, basis_gradient};
use fearless_simd::prelude::*;
use fearless_simd::{Simd, dispatch, mask32x8};
use glam::Vec3;

/// A Gaussian's summed slots: q and its first moments and the total weight, second moments and depth, colour. Then, in the third, what its
/// place gains by the colour. Sums and gradients lie as the Gaussians do.
type Reduced = [Vec4; 3];

/// Gradients in the camera's axes: point and logarithm of the opacity; log scales; turn.
type Gradients = [Vec4; 3];

/// Number of visible Gaussians.
fn visible(call: &Call<'_>) -> usize {
    call.memory.read::<Status>("status")[0].visible as usize
}

/// Sums each visible Gaussian's gradient slots in tile order. Mode 1 adds to the sum of earlier bands: one running sum either way, so that
/// the number of bands does not change a bit.
pub(super) fn reduce(call: &Call<'_>) {
    let memory = &call.memory;
    let (ranges, slots) = (memory.read::<[u32; 2]>("slot_ranges"), memory.read::<Reduced>("slots"));
    let (shaded, order) = (memory.read::<[Vec4; 3]>("shaded"), memory.read::<u32>("order"));
    // SAFETY: the only section that this kernel writes.
    let reduced = Parts::of(unsafe { memory.write::<Reduced>("reduced") });
    let (n, has_depth, adds) = (visible(call), call.frame.has(FLAG_DEPTH), call.push.mode == 1);
    call.pool.each(n.div_ceil(SHARE), |share| {
        dispatch!(call.level, _s => {
            for r in share * SHARE..((share + 1) * SHARE).min(n) {
                // SAFETY: every visible Gaussian has a place of its own.
                let out = unsafe { &mut reduced.range(order[r] as usize, 1)[0] };
                let [start, slot_count] = ranges[r].map(|n| n as usize);
                let mut sum = sum_of(&slots[start..start + slot_count], if adds { *out } else { [[0.0; 4]; 3] }, has_depth);
                // Where the colour was clamped there is no gradient.
                for c in 0..3 {
                    let clamped = shaded[r][2][c] <= 0.0 || shaded[r][2][c] >= COLOUR_MAX;
                    sum[2][c] = if clamped { 0.0 } else { sum[2][c] };
                }
                *out = sum;
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
    call.pool.each(call.shares(), |share| {
        dispatch!(call.level, s => {
            for (g, _) in seen(ranks, call.share(share)) {
                // SAFETY: a share of the Gaussians for each part.
                let own = unsafe { &mut reduced.range(g, 1)[0] };
                own[2] = step_sh(s, call, (&harmonics, &rates), &camera, g, &geometry[g], own[2]);
            }
        });
    });
}

/// Steps a Gaussian's SH; returns the gradient by its place, and whether the colour's was finite.
#[inline(always)]
fn step_sh<S: Simd>(
    s: S,
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
    let [red, green, blue, _] = finite([by_color[0], by_color[1], by_color[2], 0.0], &mut all_finite);
    let away = three(geometry[0]) - camera.center;
    let distance = away.length().max(1.0e-12);
    let direction = away / distance;
    let degree = call.degree(state) as u8;
    let gradients = channels_of(&basis(degree, direction.to_array()), [red, green, blue]);
    let channels = [red, green, blue, red, green, blue, red, green, blue, red];
    let (at, held) = (g * harmonics.stride, call.held(state));
    let (adam, zero) = (Adam::of(s, frame), splat(s, 0.0));
    let (weight, small) = (splat(s, frame.sh_weight), splat(s, SH_SMALL));
    // Each coefficient times the gradient of its channel's colour.
    let mut products = [0.0; MOST];
    for i in (0..held).step_by(LANES) {
        let count = LANES.min(held - i);
        // SAFETY: numbers of this part's Gaussian.
        let own = unsafe { harmonics.sh.range(at + i, count) };
        let (before, gradient) = (load(s, own), F8::from_slice(s, &gradients[i..i + LANES]));
        let by_channel = F8::from_slice(s, &channels[i % 3..i % 3 + LANES]);
        (before * by_channel).store_slice(&mut products[i..i + LANES]);
        // The derivative of what coefficients above degree 0 amount to. Where a picture has no gradient they count for nothing: it does
        // not show the Gaussian, or not yet that degree.
        let more = weight * before / (before.abs() + small);
        let counts = if i == 0 { ramp(s) } else { splat(s, 3.0) }.simd_ge(splat(s, 3.0)) & !gradient.simd_eq(zero);
        let gradient = gradient + counts.select(more, zero);
        // SAFETY: as above.
        unsafe {
            if call.push.mode == 1 {
                harmonics.moments.store(frame, at + i, count, [gradient, gradient * gradient]);
            } else {
                let moments = harmonics.moments.fetch(s, frame, at + i, count);
                let (p, moments) = adam.step(before, moments, gradient, F8::from_slice(s, &rates[i..i + LANES]));
                store(p, own);
                harmonics.moments.store(frame, at + i, count, moments);
            }
        }
    }
    let mut weights = [0.0; 16];
    for (weight, of_one) in weights.iter_mut().zip(products.chunks_exact(3)) {
        *weight = of_one[0] + of_one[1] + of_one[2];
    }
    let by_direction = Vec3::from_array(basis_gradient(degree, direction.to_array(), &weights));
    let place = (by_direction - direction * direction.dot(by_direction)) / distance;
    four(place, if all_finite { 0.0 } else { 1.0 })
}

/// The Gaussians of one of the lanes that leave partial sums.
fn lane_of(call: &Call<'_>, lane: usize) -> std::ops::Range<usize> {
    let n = call.frame.gaussians as usize;
    let share = n.div_ceil(call.loop_lanes());
    (lane * share).min(n)..((lane + 1) * share).min(n)
}

/// From a Gaussian's summed gradient in the picture to that of its point, scales and turn in the camera's axes, through projection; it
/// lies where the projections did.
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
        dispatch!(call.level, s => {
            let mut those = seen(ranks, lane_of(call, lane)).map(|(g, _)| g);
            loop {
                // What does not fill the lanes is the last one again.
                let (mut some, mut count) = ([0; LANES], 0);
                for g in those.by_ref().take(LANES) {
                    some[count..].fill(g);
                    count += 1;
                }
                if count == 0 {
                    break;
                }
                let (out, is_finite) = project_back(s, &camera, |lane| (&geometry[some[lane]], &reduced[some[lane]]));
                for lane in 0..count {
                    // SAFETY: every Gaussian has a place of its own.
                    unsafe { gradients.range(some[lane], 1)[0] = [out[0][lane], out[1][lane], out[2][lane]] };
                    sums.non_finite += u32::from(is_finite >> lane & 1 == 0);
                }
            }
        });
    });
}

/// Numbers that Adam can take: what is not finite, or too large to be squared, becomes zero and is told.
#[inline(always)]
fn bounded<S: Simd>(v: F8<S>, all_finite: &mut mask32x8<S>) -> F8<S> {
    let s = v.token();
    // Written so that what is not a number fails.
    let good = v.abs().simd_lt(splat(s, 1.0e18));
    *all_finite &= good;
    good.select(v, splat(s, 0.0))
}

/// Gradients of eight Gaussians, row by row, and a bit for each whose were all finite.
#[inline(always)]
fn project_back<'a, S: Simd>(
    s: S,
    camera: &Camera,
    of: impl Fn(usize) -> (&'a Geometry, &'a Reduced),
) -> ([[Vec4; LANES]; 3], u64) {
    let own = [fetch(s, |i| of(i).0[0]), fetch(s, |i| of(i).0[1]), fetch(s, |i| of(i).0[2])];
    let [line, square, by_color] = [fetch(s, |i| of(i).1[0]), fetch(s, |i| of(i).1[1]), fetch(s, |i| of(i).1[2])];
    let p = Projection::of(s, camera, own[0], own[1], own[2]);
    let zero = splat(s, 0.0);
    let inverse_z = splat(s, 1.0) / p.p.z;
    let conic = p.conic(s);
    let (fx, fy) = (inverse_z * camera.focal.x, inverse_z * camera.focal.y);
    let mut all_finite = zero.simd_eq(zero);

    // Covariance: dL/dM = K S K M for the projected axes M = (a, b).
    let (k_s_xx, k_s_xy) = (conic[0] * square[0] + conic[1] * square[1], conic[0] * square[1] + conic[1] * square[2]);
    let (k_s_yx, k_s_yy) = (conic[1] * square[0] + conic[2] * square[1], conic[1] * square[1] + conic[2] * square[2]);
    let (xx, xy) = (k_s_xx * conic[0] + k_s_xy * conic[1], k_s_xx * conic[1] + k_s_xy * conic[2]);
    let yy = k_s_yx * conic[1] + k_s_yy * conic[2];
    let ga = p.a.times(xx).plus(p.b.times(xy));
    let gb = p.a.times(xy).plus(p.b.times(yy));
    let az = V3 { x: p.axes[0].z, y: p.axes[1].z, z: p.axes[2].z };
    let ratio_x = p.clamped[0].select(zero, -fx * ga.dot(az));
    let ratio_y = p.clamped[1].select(zero, -fy * gb.dot(az));
    let nearer = (ratio_x * p.p.x + ratio_y * p.p.y) * inverse_z + ga.dot(p.a) + gb.dot(p.b);

    // Place in the picture, then the point in the camera's axes.
    let screen_x = (conic[0] * line[1] + conic[1] * line[2]) * fx;
    let screen_y = (conic[1] * line[1] + conic[2] * line[2]) * fy;
    let depth = square[3] - (screen_x * p.p.x + screen_y * p.p.y + nearer) * inverse_z;
    let place = [
        bounded(screen_x + ratio_x * inverse_z, &mut all_finite),
        bounded(screen_y + ratio_y * inverse_z, &mut all_finite),
        bounded(depth, &mut all_finite),
        bounded(line[0], &mut all_finite),
    ];

    // The axes turned together and stretched each: no gradient of a rotation matrix is needed.
    let by_axis = |a: F8<S>, b: F8<S>| -> V3<S> {
        let (x, y) = (fx * a, fy * b);
        V3 { x, y, z: -p.ratio[0] * x - p.ratio[1] * y }
    };
    let by_axes = [by_axis(ga.x, gb.x), by_axis(ga.y, gb.y), by_axis(ga.z, gb.z)];
    let turn = p.axes[0].cross(by_axes[0]).plus(p.axes[1].cross(by_axes[1])).plus(p.axes[2].cross(by_axes[2]));
    let stretch = [
        bounded(p.scale_clamped[0].select(zero, p.axes[0].dot(by_axes[0])), &mut all_finite),
        bounded(p.scale_clamped[1].select(zero, p.axes[1].dot(by_axes[1])), &mut all_finite),
        bounded(p.scale_clamped[2].select(zero, p.axes[2].dot(by_axes[2])), &mut all_finite),
        zero,
    ];
    // What `optimise` makes of it for a quaternion that is nearly nothing is as long as that is short.
    let longer = splat(s, 2.0) / p.q_length;
    for v in [turn.x, turn.y, turn.z] {
        bounded(v * longer, &mut all_finite);
    }
    let turn =
        [bounded(turn.x, &mut all_finite), bounded(turn.y, &mut all_finite), bounded(turn.z, &mut all_finite), zero];
    for v in &by_color[..3] {
        bounded(*v, &mut all_finite);
    }
    let all_finite = all_finite & by_color[3].simd_eq(zero);
    ([rows(place), rows(stretch), rows(turn)], all_finite.to_bitmask())
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
        for (g, _) in seen(ranks, lane_of(call, lane)) {
            let p = camera.point(three(geometry[g][0]));
            let point = three(gradients[g][0]);
            turn += p.cross(point) + three(gradients[g][2]);
            // The camera sees the world move; with it moves the direction that SH are seen from.
            shift += point + camera.turned(three(reduced[g][2]));
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
    call.pool.each(call.shares(), |share| {
        dispatch!(call.level, _s => {
            for (g, _) in seen(ranks, call.share(share)) {
                // SAFETY: a share of the Gaussians for each part.
                let own = unsafe { &mut geometry.range(g, 1)[0] };
                let by = to_world(&camera, own, &gradients[g], &reduced[g], entropy_weight);
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
