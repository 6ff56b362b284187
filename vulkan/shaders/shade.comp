#version 450
// Gathers the visible Gaussians in depth order and evaluates their colours, each at its own SH degree; `catch_up` went before.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "harmonics.glsl"
#include "deferred.glsl"

TEXELS(vec4, 9, projected)
TEXELS(vec4, 10, geometry_texels)
TEXELS(vec4, 11, sh_texels)
layout(std430, set = 0, binding = 1) readonly buffer Order { uint order[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer Shaded { vec4 shaded[]; };

// One of a Gaussian's columns of SH; nothing beyond those that it holds.
vec4 column(uint g, uint c, uint held) {
    if (c >= SH_COLUMNS || (OWN_DEGREES && c >= held)) return vec4(0.0);
    return FETCH(sh_texels, int(g * SH_COLUMNS + c));
}

// Adds four coefficients in three columns, the first of them `c`, times their basis functions.
void add_four(inout vec3 colour, vec4 basis, uint g, uint c, uint held) {
    if (c >= SH_COLUMNS) return;
    vec4 p = column(g, c, held), q = column(g, c + 1u, held), r = column(g, c + 2u, held);
    colour += basis.x * p.xyz;
    colour += basis.y * vec3(p.w, q.xy);
    colour += basis.z * vec3(q.zw, r.x);
    colour += basis.w * r.yzw;
}

void main() {
    uint n = status.visible;
    for (uint r = gl_GlobalInvocationID.x; r < n; r += LOOP_LANES) {
        uint g = order[r], own = SH_DEGREE;
        vec3 mean = FETCH(geometry_texels, int(g) * 9).xyz;
        if (OWN_DEGREES) own = state_degree(floatBitsToUint(FETCH(geometry_texels, int(g) * 9 + 1).w));
        uint held = columns_up_to(own), degree = min(frame.sh_degree, own);
        // An orthographic view looks along its axis everywhere.
        vec3 view_direction = (frame.flags & FLAG_ORTHOGRAPHIC) != 0u ? frame.view_rows[2].xyz : mean - frame.camera_center;
        vec3 d = normalize(view_direction), colour = vec3(0.5);
        [[unroll]] for (uint i = 0u; i < 16u; i += 4u) {
            add_four(colour, harmonics_from(i, d, degree), g, i * 3u / 4u, held);
        }
        shaded[r * 3 + 0] = FETCH(projected, int(g) * 3);
        shaded[r * 3 + 1] = FETCH(projected, int(g) * 3 + 1);
        shaded[r * 3 + 2] = vec4(clamp(colour, vec3(0.0), vec3(COLOUR_MAX)), 0.0);
    }
}
