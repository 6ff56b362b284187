#version 450
// From the gradient of a Gaussian's colour to its SH, and Adam in the same breath: no gradient of a coefficient is ever stored. What the
// Gaussian's place gains from it, through the direction that it is seen from, is left where the colour's gradient was, for `project_backward`.
// With that and `optimise` it is one stage, in three kernels because a board's lane has no registers for all of it at once. Mode 1 writes
// the gradient to where the first moment is and changes nothing else (gradient checks).
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "harmonics.glsl"
#include "deferred.glsl"
#include "moments.glsl"
#include "adam.glsl"

// Parameters are fetched as texels and written back through buffers; each lane touches only its own Gaussians.
TEXELS(vec4, 9, reduced)
TEXELS(vec4, 10, geometry_texels)
TEXELS(vec4, 11, sh_texels)
layout(std430, set = 0, binding = 1) readonly buffer Order { uint order[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer ByPlace { vec4 by_place[]; }; // in `reduced`; w: 1 where not finite
layout(std430, set = 0, binding = 4) writeonly buffer Sh { vec4 sh[]; };

// The derivative of what coefficients above degree 0 amount to. Where a picture has no gradient they count for nothing: it does not show the
// Gaussian, or not yet that degree.
vec4 magnitude_gradient(uint c, vec4 p, vec4 gradient) {
    vec4 g = mix(p / (abs(p) + SH_SMALL), vec4(0.0), equal(gradient, vec4(0.0)));
    return c == 0u ? vec4(0.0, 0.0, 0.0, g.w) : g;
}

// One of a Gaussian's columns of SH; what it was before this step.
vec4 step_column(uint g, uint c, uint held, vec4 gradient) {
    if (c >= SH_COLUMNS || (OWN_DEGREES && c >= held)) return vec4(0.0);
    int at = int(g * SH_COLUMNS + c);
    vec4 before = FETCH(sh_texels, at);
    gradient += frame.sh_weight * magnitude_gradient(c, before, gradient);
    if (push.mode == 1u) {
        store_moments(uint(at), gradient, gradient * gradient);
    } else {
        vec4 p = before, m, v;
        fetch_moments(at, m, v);
        vec4 rate = vec4(frame.sh_rest_rate);
        if (c == 0u) rate.xyz = vec3(frame.sh_dc_rate);
        adam(p, m, v, gradient, rate);
        sh[at] = p;
        store_moments(uint(at), m, v);
    }
    return before;
}

// Four coefficients in three columns, the first of them `c`; what they were times the colour's gradient `gc`.
vec4 step_four(uint g, uint c, uint held, vec4 basis, vec3 gc) {
    if (c >= SH_COLUMNS) return vec4(0.0);
    vec4 p = step_column(g, c, held, vec4(basis.x * gc, basis.y * gc.x));
    vec4 q = step_column(g, c + 1u, held, vec4(basis.y * gc.yz, basis.z * gc.xy));
    vec4 r = step_column(g, c + 2u, held, vec4(basis.z * gc.z, basis.w * gc));
    return vec4(dot(gc, p.xyz), dot(gc, vec3(p.w, q.xy)), dot(gc, vec3(q.zw, r.x)), dot(gc, r.yzw));
}

void main() {
    uint n = status.visible;
    for (uint r = gl_GlobalInvocationID.x; r < n; r += LOOP_LANES) {
        uint g = order[r];
        int third = int(r) * 3 + 2;
        vec3 mean = FETCH(geometry_texels, int(g) * 9).xyz;
        // The basis functions of a direction are finite and at most 1.5.
        bool all_finite = true;
        vec3 gc = finite(vec4(FETCH(reduced, third).xyz, 0.0), all_finite).xyz;
        vec3 away = mean - frame.camera_center;
        float distance = max(length(away), 1.0e-12);
        vec3 direction = away / distance;
        uint own = SH_DEGREE;
        if (OWN_DEGREES) own = state_degree(floatBitsToUint(FETCH(geometry_texels, int(g) * 9 + 1).w));
        uint held = columns_up_to(own), degree = min(frame.sh_degree, own);
        vec3 by_direction = vec3(0.0);
        [[unroll]] for (uint i = 0u; i < 16u; i += 4u) {
            vec4 weight = step_four(g, i * 3u / 4u, held, harmonics_from(i, direction, degree), gc);
            by_direction += gradient_from(i, direction, degree, weight);
        }
        vec3 place = (by_direction - direction * dot(direction, by_direction)) / distance;
        by_place[third] = vec4(place, all_finite ? 0.0 : 1.0);
    }
}
