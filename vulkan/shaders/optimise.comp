#version 450
// From a Gaussian's summed screen-space gradient to its parameters, through projection and colour, and Adam in the same
// breath: no gradient of a parameter is ever stored. Also sums the camera pose's gradient (one partial per lane).
// Mode 1 writes the gradient to where the first moment is and changes nothing else (gradient checks).
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
// Orthographic views are drawn, never trained on.
#define PERSPECTIVE_ONLY
#include "projection.glsl"
#include "harmonics.glsl"
#include "deferred.glsl"
#include "moments.glsl"

// Parameters are fetched as texels and written back through buffers; each lane touches only its own Gaussians.
TEXELS(vec4, 9, reduced)
TEXELS(vec4, 10, geometry_texels)
TEXELS(vec4, 11, sh_texels)
layout(std430, set = 0, binding = 1) readonly buffer Order { uint order[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer Geometry { vec4 geometry[]; };
layout(std430, set = 0, binding = 4) writeonly buffer Sh { vec4 sh[]; };
layout(std430, set = 0, binding = 7) writeonly buffer LaneSums { PoseSums lane_sums[]; };

void adam(inout vec4 p, inout vec4 m, inout vec4 v, vec4 g, vec4 rate) {
    m += (g - m) * (1.0 - frame.beta1);
    v += (g * g - v) * (1.0 - frame.beta2);
    p -= rate * (m * frame.first_bias) / (sqrt(v * frame.second_bias) + frame.epsilon);
}

vec4 finite(vec4 g, inout bool all_finite) {
    bvec4 bad = not(lessThan(abs(g), vec4(1.0e18))); // also NaN; larger squares would overflow the second moment
    all_finite = all_finite && !any(bad);
    return mix(g, vec4(0.0), bad);
}

// Box-Muller from two hashes.
float normal_hash(uint gaussian, uint channel) {
    float u = max(uniform_hash(gaussian, channel), 5.0e-8), w = uniform_hash(gaussian, channel + 1u);
    return sqrt(-2.0 * log(u)) * cos(6.2831853 * w);
}

void main() {
    uint n = status.visible, lane = gl_GlobalInvocationID.x, non_finite = 0u;
    vec3 pose_turn = vec3(0.0), pose_shift = vec3(0.0);
    for (uint r = lane; r < n; r += LOOP_LANES) {
        uint g = order[r];
        int sum = int(r) * 3, row = int(g) * 9;
        vec4 s0 = FETCH(reduced, sum), s1 = FETCH(reduced, sum + 1), s2 = FETCH(reduced, sum + 2);
        vec4 p0 = FETCH(geometry_texels, row), p1 = FETCH(geometry_texels, row + 1);
        vec4 p2 = FETCH(geometry_texels, row + 2);
        Projection s = project_gaussian(p0.xyz, p1.xyz, p2);
        float inverse_z = 1.0 / s.p.z, inverse_det = 1.0 / s.det;
        vec3 conic = vec3(s.cov.z, -s.cov.y, s.cov.x) * inverse_det;

        // Screen position, then the camera-space point.
        vec2 screen = vec2(conic.x * s0.y + conic.y * s0.z, conic.y * s0.y + conic.z * s0.z);
        vec2 f = frame.focal * inverse_z;
        vec3 point = vec3(screen * f, 0.0);
        point.z = s1.w - dot(screen * f, s.p.xy) * inverse_z;

        // Covariance: dL/dM = K S K M for the projected axes M = (a, b).
        mat2 k = mat2(conic.x, conic.y, conic.y, conic.z);
        mat2 ksk = k * mat2(s1.x, s1.y, s1.y, s1.z) * k;
        vec3 ga = ksk[0][0] * s.a + ksk[0][1] * s.b;
        vec3 gb = ksk[0][1] * s.a + ksk[1][1] * s.b;
        vec3 az = vec3(s.axes[0].z, s.axes[1].z, s.axes[2].z);
        mat3 axes;
        for (int i = 0; i < 3; i++) {
            float x = f.x * ga[i], y = f.y * gb[i];
            axes[i] = vec3(x, y, -s.ratio.x * x - s.ratio.y * y);
        }
        vec2 ratio = -f * vec2(dot(ga, az), dot(gb, az));
        ratio = mix(ratio, vec2(0.0), s.clamped);
        point.xy += ratio * inverse_z;
        point.z -= (dot(ratio, s.p.xy * inverse_z) + dot(ga, s.a) + dot(gb, s.b)) * inverse_z;

        // Own axes: columns of R diag(s).
        mat3 turned;
        vec3 log_scale;
        for (int i = 0; i < 3; i++) {
            vec3 world = to_world(axes[i]);
            log_scale[i] = s.scale_clamped[i] ? 0.0 : dot(world, s.rotation[i]) * s.scale[i];
            turned[i] = world * s.scale[i];
        }
        float w = s.q.x, x = s.q.y, y = s.q.z, z = s.q.w;
        // turned[column][row] = dL/dR.
        vec4 q = 2.0 * vec4(
            x * (turned[1][2] - turned[2][1]) + y * (turned[2][0] - turned[0][2]) + z * (turned[0][1] - turned[1][0]),
            -2.0 * x * (turned[1][1] + turned[2][2]) + y * (turned[1][0] + turned[0][1]) + z * (turned[2][0] + turned[0][2])
                + w * (turned[1][2] - turned[2][1]),
            x * (turned[1][0] + turned[0][1]) - 2.0 * y * (turned[0][0] + turned[2][2]) + z * (turned[2][1] + turned[1][2])
                + w * (turned[2][0] - turned[0][2]),
            x * (turned[2][0] + turned[0][2]) + y * (turned[2][1] + turned[1][2]) - 2.0 * z * (turned[0][0] + turned[1][1])
                + w * (turned[0][1] - turned[1][0]));
        vec4 rotation = (q - s.q * dot(s.q, q)) / s.q_length;

        // Colour, clamped below at 0: no gradient where the clamp holds.
        vec3 away = p0.xyz - frame.camera_center;
        float distance = max(length(away), 1.0e-12);
        vec3 direction = away / distance;
        float basis[16], weight[16], coefficient[48];
        uint own = OWN_DEGREES ? state_degree(floatBitsToUint(p1.w)) : SH_DEGREE, held = COLUMNS_UP_TO[own];
        uint degree = min(frame.sh_degree, own);
        harmonics(direction, degree, basis);
        [[unroll]] for (uint i = 0u; i < 48u; i++) coefficient[i] = 0.0;
        [[unroll]] for (uint c = 0u; c < SH_COLUMNS; c++) {
            if (!OWN_DEGREES || c < held) {
                vec4 p = FETCH(sh_texels, int(g * SH_COLUMNS + c));
                [[unroll]] for (uint j = 0u; j < 4u; j++) coefficient[c * 4u + j] = p[j];
            }
        }
        vec3 colour = vec3(0.5);
        [[unroll]] for (uint i = 0u; i < COEFFICIENTS; i++) {
            colour += basis[i] * vec3(coefficient[i * 3u], coefficient[i * 3u + 1u], coefficient[i * 3u + 2u]);
        }
        vec3 gc = s2.xyz;
        for (int i = 0; i < 3; i++) if (colour[i] <= 0.0 || colour[i] >= COLOUR_MAX) gc[i] = 0.0;
        [[unroll]] for (uint i = 0u; i < 16u; i++) weight[i] = 0.0;
        [[unroll]] for (uint i = 1u; i < COEFFICIENTS; i++) {
            weight[i] = dot(gc, vec3(coefficient[i * 3u], coefficient[i * 3u + 1u], coefficient[i * 3u + 2u]));
        }
        vec3 by_direction = harmonics_gradient(direction, degree, weight);
        vec3 by_place = (by_direction - direction * dot(direction, by_direction)) / distance;

        // Camera: p' = exp(turn) p + shift; the SH direction sees the centre move by -R' shift.
        pose_shift += point + to_camera(by_place);
        pose_turn += cross(s.p, point);
        for (int i = 0; i < 3; i++) pose_turn += cross(s.axes[i], axes[i]);

        bool all_finite = true;
        float opacity = sigmoid(p0.w);
        // d/dx of the binary entropy of sigmoid(x) is -x sigmoid'(x); the mean is over those in view.
        float entropy = -frame.entropy_weight / float(n) * p0.w * opacity * (1.0 - opacity);
        vec4 g0 = finite(vec4(to_world(point) + by_place, s0.x * (1.0 - opacity) + entropy), all_finite);
        vec4 g1 = finite(vec4(log_scale, 0.0), all_finite);
        vec4 g2 = finite(rotation, all_finite);
        if (push.mode == 1u) {
            geometry[g * 9 + 3] = g0;
            geometry[g * 9 + 4] = g1;
            geometry[g * 9 + 5] = g2;
        } else {
            vec4 m = FETCH(geometry_texels, row + 3), v = FETCH(geometry_texels, row + 6);
            adam(p0, m, v, g0, vec4(vec3(frame.mean_rate), frame.opacity_rate));
            geometry[g * 9 + 3] = m;
            geometry[g * 9 + 6] = v;
            // Noise on what is nearly transparent, so that it finds a place where it is of use (MCMC, Brush's form).
            float loose = frame.noise * pow(1.0 - opacity, 150.0);
            if (loose > 0.0) {
                vec3 noise = vec3(normal_hash(g, 0u), normal_hash(g, 2u), normal_hash(g, 4u));
                p0.xyz += clamp(noise * loose, vec3(-frame.max_noise), vec3(frame.max_noise));
            }
            m = FETCH(geometry_texels, row + 4);
            v = FETCH(geometry_texels, row + 7);
            adam(p1, m, v, g1, vec4(vec3(frame.log_scale_rate), 0.0));
            p1.w = uintBitsToFloat(state_of(frame.step, frame.step, own));
            geometry[g * 9 + 4] = m;
            geometry[g * 9 + 7] = v;
            m = FETCH(geometry_texels, row + 5);
            v = FETCH(geometry_texels, row + 8);
            adam(p2, m, v, g2, vec4(frame.rotation_rate));
            geometry[g * 9 + 5] = m;
            geometry[g * 9 + 8] = v;
            geometry[g * 9] = p0;
            geometry[g * 9 + 1] = p1;
            geometry[g * 9 + 2] = p2;
        }
        [[unroll]] for (uint c = 0u; c < SH_COLUMNS; c++) {
            if (!OWN_DEGREES || c < held) {
                vec4 gradient = vec4(0.0), p;
                [[unroll]] for (uint j = 0u; j < 4u; j++) {
                    uint i = (c * 4u + j) / 3u;
                    if (i < COEFFICIENTS) gradient[j] = basis[i] * gc[(c * 4u + j) % 3u];
                    p[j] = coefficient[c * 4u + j];
                }
                gradient = finite(gradient, all_finite);
                if (push.mode == 1u) {
                    store_moments(g * SH_COLUMNS + c, gradient, gradient * gradient);
                } else {
                    int at = int(g * SH_COLUMNS + c);
                    vec4 m, v;
                    fetch_moments(at, m, v);
                    vec4 rate = vec4(frame.sh_rest_rate);
                    if (c == 0u) rate.xyz = vec3(frame.sh_dc_rate);
                    adam(p, m, v, gradient, rate);
                    sh[g * SH_COLUMNS + c] = p;
                    store_moments(uint(at), m, v);
                }
            }
        }
        non_finite += all_finite ? 0u : 1u;
    }
    lane_sums[lane] = PoseSums(pose_turn, non_finite, pose_shift, 0.0);
}
