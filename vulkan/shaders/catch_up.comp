#version 450
// The lazy Adam updates of SH that the visible Gaussians missed outside the view, before `shade` reads them; mode 1: those of all. Most
// missed none, and a branch costs llvmpipe what is behind it whether it is taken or not: each lane looks for its next one in a loop.
// In the order in which Gaussians lie, where `project` has just left their keys. 683 Gaussians a lane at the most (`config::plan`), 14 turns
// each: fewer than the 65,535 after which llvmpipe ends an invocation's loops. Reference: the lazy updates of src/reference/adam.rs.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "harmonics.glsl"
#include "deferred.glsl"
#include "moments.glsl"

TEXELS(vec4, 10, geometry_texels)
TEXELS(vec4, 11, sh_texels)
layout(std430, set = 0, binding = 1) readonly buffer Keys { uint keys[]; };
layout(std430, set = 0, binding = 3) writeonly buffer Geometry { vec4 geometry[]; };
layout(std430, set = 0, binding = 4) writeonly buffer Sh { vec4 sh[]; };

void main() {
    bool all_of_them = push.mode == 1u;
    uint n = frame.gaussians, next = gl_GlobalInvocationID.x;
    while (next < n) {
        uint g = 0u, state = 0u, behind = 0u;
        vec4 p1 = vec4(0.0);
        for (; behind == 0u && next < n; next += LOOP_LANES) {
            g = next;
            p1 = FETCH(geometry_texels, int(g) * 9 + 1);
            state = floatBitsToUint(p1.w);
            bool visible = all_of_them || keys[g] != 0xFFFFFFFFu;
            behind = visible ? steps_behind(state_sh(state), frame.step - 1u) : 0u;
        }
        if (behind == 0u) return;
        MissedSteps missed = frame.deferred[behind];
        p1.w = uintBitsToFloat(state_of(state_geometry(state), frame.step - 1u, state_degree(state)));
        geometry[g * 9 + 1] = p1;
        uint held = OWN_DEGREES ? min(columns_up_to(state_degree(state)), SH_COLUMNS) : SH_COLUMNS;
        for (uint c = 0u; c < held; c++) {
            int at = int(g * SH_COLUMNS + c);
            vec4 p = FETCH(sh_texels, at), m, v;
            fetch_moments(at, m, v);
            vec4 rate = vec4(frame.sh_rest_rate);
            if (c == 0u) rate.xyz = vec3(frame.sh_dc_rate);
            catch_up(p, m, v, missed.unit * rate, missed);
            sh[at] = p;
            store_moments(uint(at), m, v);
        }
    }
}
