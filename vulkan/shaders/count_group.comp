#version 450
// As count.comp, with a workgroup instead of a lane for each share of the Gaussians, one Gaussian per lane. Counting is a
// sum of integers, so that the order of the atomics does not matter.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "spans.glsl"
#include "walk.glsl"

layout(set = 0, binding = 9) uniform samplerBuffer projected;
layout(set = 0, binding = 10) uniform usamplerBuffer order;
layout(std430, set = 0, binding = 1) buffer Tiles { uint tiles[]; };
layout(std430, set = 0, binding = 2) buffer Status { uint status[]; };

shared uint all;

void main() {
    // Everything is done in the first round.
    if (push.pass > 0u) return;
    uint own = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x, base = own * frame.window.z * frame.window.w, total = 0u;
    if (lane == 0u) all = 0u;
    barrier();
    Walk w = walk_begin(own, status[0]);
    for (uint i = w.i + lane; i < w.end; i += gl_WorkGroupSize.x) {
        int at = int(texelFetch(order, int(i)).x) * 3;
        Spans s = spans_of(texelFetch(projected, at), texelFetch(projected, at + 2));
        for (int row = s.row; row <= s.last_row; row++) {
            ivec2 span = span_in_band(s, row);
            total += uint(max(span.y - span.x + 1, 0));
            uint line = base + uint(row) * frame.window.z;
            if (push.mode == 1u) span.y = span.x - 1;
            for (int x = span.x; x <= span.y; x++) atomicAdd(tiles[line + uint(x)], 1u);
        }
    }
    atomicAdd(all, total);
    barrier();
    if (lane == 0u) {
        status[16u + own] = all;
        status[WALK_CURSORS + own * 4u + 3u] = 1u;
    }
}
