#version 450
// From a Gaussian's summed screen-space gradient to that of its point, scales and turn in camera space, through projection; it lies where
// the projections did, for `pose_sums` and `optimise`, which know what the camera's axes are in the world: a Raspberry Pi's lane has no
// registers for all of that at once. `optimise_sh` went before.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
// Orthographic views are drawn, never trained on.
#define PERSPECTIVE_ONLY
#include "projection.glsl"
#include "adam.glsl"

TEXELS(vec4, 9, reduced)
TEXELS(vec4, 10, geometry_texels)
layout(std430, set = 0, binding = 1) readonly buffer Order { uint order[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
// Three rows of each visible Gaussian, where `projected` was: point and logarithm of the opacity; log scales; turn.
layout(std430, set = 0, binding = 3) writeonly buffer Gradients { vec4 gradients[]; };
layout(std430, set = 0, binding = 4) writeonly buffer LaneSums { PoseSums lane_sums[]; };

// The gradient of one scaled axis in camera space.
vec3 axis_gradient(vec2 f, vec2 ratio, float ga, float gb) {
    float x = f.x * ga, y = f.y * gb;
    return vec3(x, y, -ratio.x * x - ratio.y * y);
}

// One register instead of three.
uint packed(bvec3 flags) {
    return uint(flags.x) | uint(flags.y) << 1 | uint(flags.z) << 2;
}

void main() {
    uint n = status.visible, lane = gl_GlobalInvocationID.x, non_finite = 0u;
    for (uint r = lane; r < n; r += LOOP_LANES) {
        uint g = order[r];
        int sum = int(r) * 3, row = int(g) * 9;
        vec3 mean = FETCH(geometry_texels, row).xyz, own_scales = FETCH(geometry_texels, row + 1).xyz;
        Projection s = project_gaussian(mean, own_scales, FETCH(geometry_texels, row + 2));
        uint clamped = packed(s.scale_clamped);
        float inverse_z = 1.0 / s.p.z, inverse_det = 1.0 / s.det;
        vec3 conic = vec3(s.cov.z, -s.cov.y, s.cov.x) * inverse_det;
        vec2 f = frame.focal * inverse_z;
        bool all_finite = true;

        // Covariance: dL/dM = K S K M for the projected axes M = (a, b).
        vec4 s1 = FETCH(reduced, sum + 1);
        mat2 k = mat2(conic.x, conic.y, conic.y, conic.z);
        mat2 ksk = k * mat2(s1.x, s1.y, s1.y, s1.z) * k;
        vec3 ga = ksk[0][0] * s.a + ksk[0][1] * s.b;
        vec3 gb = ksk[0][1] * s.a + ksk[1][1] * s.b;
        vec3 az = vec3(s.axes[0].z, s.axes[1].z, s.axes[2].z);
        vec2 ratio = -f * vec2(dot(ga, az), dot(gb, az));
        ratio = mix(ratio, vec2(0.0), s.clamped);
        float nearer = dot(ratio, s.p.xy * inverse_z) + dot(ga, s.a) + dot(gb, s.b);

        // Screen position, then the camera-space point.
        vec4 s0 = FETCH(reduced, sum);
        vec2 screen = vec2(conic.x * s0.y + conic.y * s0.z, conic.y * s0.y + conic.z * s0.z);
        vec3 point = vec3(screen * f + ratio * inverse_z, 0.0);
        point.z = s1.w - (dot(screen * f, s.p.xy) + nearer) * inverse_z;
        gradients[sum] = finite(vec4(point, s0.x), all_finite);

        // The axes turned together and stretched each: no gradient of a rotation matrix is needed.
        vec3 axis_x = axis_gradient(f, s.ratio, ga.x, gb.x);
        vec3 axis_y = axis_gradient(f, s.ratio, ga.y, gb.y);
        vec3 axis_z = axis_gradient(f, s.ratio, ga.z, gb.z);
        vec3 turn = cross(s.axes[0], axis_x) + cross(s.axes[1], axis_y) + cross(s.axes[2], axis_z);
        vec3 log_scale = vec3(dot(s.axes[0], axis_x), dot(s.axes[1], axis_y), dot(s.axes[2], axis_z));
        log_scale = mix(log_scale, vec3(0.0), bvec3(clamped & 1u, clamped & 2u, clamped & 4u));
        gradients[sum + 1] = finite(vec4(log_scale, 0.0), all_finite);
        // What `optimise` makes of it for a quaternion that is nearly nothing is as long as that is short.
        finite(vec4(turn * (2.0 / s.q_length), 0.0), all_finite);
        gradients[sum + 2] = finite(vec4(turn, 0.0), all_finite);

        vec4 by_colour = finite(FETCH(reduced, sum + 2), all_finite);
        all_finite = all_finite && by_colour.w == 0.0;
        non_finite += all_finite ? 0u : 1u;
    }
    lane_sums[lane].non_finite = non_finite;
}
