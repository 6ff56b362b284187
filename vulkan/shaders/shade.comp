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

void main() {
    bool catch_up_only = push.mode == 1u;
    uint n = catch_up_only ? frame.gaussians : status.visible;
    for (uint r = gl_GlobalInvocationID.x; r < n; r += LOOP_LANES) {
        uint g = r;
        if (!catch_up_only) g = order[r];
        vec4 p0 = FETCH(geometry_texels, int(g) * 9), p1 = FETCH(geometry_texels, int(g) * 9 + 1);
        uint state = floatBitsToUint(p1.w);
        uint behind = steps_behind(state_sh(state), frame.step - 1u);
        float coefficient[48];
        MissedSteps missed = MissedSteps(0.0, 0.0, 0.0, 0.0);
        if (behind > 0u) {
            missed = frame.deferred[behind];
            p1.w = uintBitsToFloat(state_of(state_geometry(state), frame.step - 1u, state_degree(state)));
            geometry[g * 9 + 1] = p1;
        }
        [[unroll]] for (uint i = 0u; i < 48u; i++) coefficient[i] = 0.0;
        uint own = OWN_DEGREES ? state_degree(state) : SH_DEGREE, held = COLUMNS_UP_TO[own];
        [[unroll]] for (uint c = 0u; c < SH_COLUMNS; c++) {
            if (!OWN_DEGREES || c < held) {
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
                [[unroll]] for (uint k = 0u; k < 4u; k++) coefficient[c * 4u + k] = p[k];
            }
        }
        float y[16];
        // An orthographic view looks along its axis everywhere.
        vec3 view_direction = (frame.flags & FLAG_ORTHOGRAPHIC) != 0u ? frame.view_rows[2].xyz : p0.xyz - frame.camera_center;
        harmonics(normalize(view_direction), min(frame.sh_degree, own), y);
        vec3 colour = vec3(0.5);
        [[unroll]] for (uint i = 0u; i < COEFFICIENTS; i++) {
            colour += y[i] * vec3(coefficient[i * 3u], coefficient[i * 3u + 1u], coefficient[i * 3u + 2u]);
        }
        if (!catch_up_only) {
            shaded[r * 3 + 0] = FETCH(projected, int(g) * 3);
            shaded[r * 3 + 1] = FETCH(projected, int(g) * 3 + 1);
            shaded[r * 3 + 2] = vec4(clamp(colour, vec3(0.0), vec3(COLOUR_MAX)), 0.0);
        }
    }
}
