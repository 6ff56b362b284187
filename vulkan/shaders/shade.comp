#version 450
// Gathers the visible Gaussians in depth order and evaluates their colours, each at its own SH degree, after the lazy Adam
// updates of the SH that they missed outside the view. Mode 1 does those updates for all Gaussians and shades nothing.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "harmonics.glsl"
#include "deferred.glsl"
#include "moments.glsl"

TEXELS(vec4, 9, projected)
TEXELS(vec4, 10, geometry_texels)
TEXELS(vec4, 11, sh_texels)
layout(std430, set = 0, binding = 1) readonly buffer Order { uint order[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer Geometry { vec4 geometry[]; };
layout(std430, set = 0, binding = 4) writeonly buffer Sh { vec4 sh[]; };
layout(std430, set = 0, binding = 7) writeonly buffer Shaded { vec4 shaded[]; };

// One of a Gaussian's columns of SH, which it missed `behind` updates of; nothing beyond those that it holds.
vec4 column(uint g, uint c, uint held, uint behind, MissedSteps missed) {
    if (c >= SH_COLUMNS || (OWN_DEGREES && c >= held)) return vec4(0.0);
    int at = int(g * SH_COLUMNS + c);
    vec4 p = FETCH(sh_texels, at);
    if (behind > 0u) {
        vec4 m, v;
        fetch_moments(at, m, v);
        vec4 rate = vec4(frame.sh_rest_rate);
        if (c == 0u) rate.xyz = vec3(frame.sh_dc_rate);
        catch_up(p, m, v, missed.unit * rate, missed);
        sh[at] = p;
        store_moments(uint(at), m, v);
    }
    return p;
}

// Adds four coefficients in three columns, the first of them `c`, times their basis functions.
void add_four(inout vec3 colour, vec4 basis, uint g, uint c, uint held, uint behind, MissedSteps missed) {
    if (c >= SH_COLUMNS) return;
    vec4 p = column(g, c, held, behind, missed), q = column(g, c + 1u, held, behind, missed);
    vec4 r = column(g, c + 2u, held, behind, missed);
    colour += basis.x * p.xyz;
    colour += basis.y * vec3(p.w, q.xy);
    colour += basis.z * vec3(q.zw, r.x);
    colour += basis.w * r.yzw;
}

void main() {
    bool catch_up_only = push.mode == 1u;
    uint n = catch_up_only ? frame.gaussians : status.visible;
    for (uint r = gl_GlobalInvocationID.x; r < n; r += LOOP_LANES) {
        uint g = r;
        if (!catch_up_only) g = order[r];
        vec4 p0 = FETCH(geometry_texels, int(g) * 9), p1 = FETCH(geometry_texels, int(g) * 9 + 1);
        uint state = floatBitsToUint(p1.w);
        uint behind = steps_behind(state_sh(state), frame.step - 1u);
        MissedSteps missed = MissedSteps(0.0, 0.0, 0.0, 0.0);
        if (behind > 0u) {
            missed = frame.deferred[behind];
            p1.w = uintBitsToFloat(state_of(state_geometry(state), frame.step - 1u, state_degree(state)));
            geometry[g * 9 + 1] = p1;
        }
        uint own = OWN_DEGREES ? state_degree(state) : SH_DEGREE, held = columns_up_to(own);
        // An orthographic view looks along its axis everywhere.
        vec3 view_direction = (frame.flags & FLAG_ORTHOGRAPHIC) != 0u ? frame.view_rows[2].xyz : p0.xyz - frame.camera_center;
        vec3 d = normalize(view_direction), colour = vec3(0.5);
        uint degree = min(frame.sh_degree, own);
        [[unroll]] for (uint i = 0u; i < 16u; i += 4u) {
            add_four(colour, harmonics_from(i, d, degree), g, i * 3u / 4u, held, behind, missed);
        }
        if (!catch_up_only) {
            shaded[r * 3 + 0] = FETCH(projected, int(g) * 3);
            shaded[r * 3 + 1] = FETCH(projected, int(g) * 3 + 1);
            shaded[r * 3 + 2] = vec4(clamp(colour, vec3(0.0), vec3(COLOUR_MAX)), 0.0);
        }
    }
}
