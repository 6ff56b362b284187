#version 450
// As count.comp, with a workgroup instead of a lane for each share of the Gaussians, one Gaussian per lane. Counting is a
// sum of integers, so that the order of the atomics does not matter.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "spans.glsl"
#include "walk.glsl"

TEXELS(vec4, 9, projected)
TEXELS(uint, 10, order)
layout(std430, set = 0, binding = 1) buffer Tiles { uint tiles[]; };
layout(std430, set = 0, binding = 2) buffer StatusWords { Status status; };

shared uint all;

void main() {
    // Everything is done in the first round.
    if (push.pass > 0u) return;
    uint own = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x, base = own * frame.window.x * frame.window.y, total = 0u;
    if (lane == 0u) all = 0u;
    barrier();
    Walk w = walk_begin(own, status.visible);
    for (uint i = w.i + lane; i < w.end; i += gl_WorkGroupSize.x) {
        int at = int(FETCH(order, int(i)).x) * 3;
        Spans s = spans_of(FETCH(projected, at), FETCH(projected, at + 2));
        for (int row = s.row; row <= s.last_row; row++) {
            ivec2 span = span_in_band(s, row);
            total += uint(max(span.y - span.x + 1, 0));
            uint line = base + uint(row) * frame.window.x;
            if (push.mode == 1u) span.y = span.x - 1;
            for (int x = span.x; x <= span.y; x++) atomicAdd(tiles[line + uint(x)], 1u);
        }
    }
    atomicAdd(all, total);
    barrier();
    if (lane == 0u) {
        status.lane_instances[own] = all;
        status.lane_counted[own] = 1u;
    }
}
