#version 450
// As emit.comp, with a workgroup instead of a lane for each share of the Gaussians: one Gaussian after another, in depth
// order, and of each a row of tiles per lane, so that every instance gets the place and the slot it always gets.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "spans.glsl"
#include "walk.glsl"

TEXELS(vec4, 9, projected)
TEXELS(uint, 10, order)
TEXELS(uint, 11, starts)
// Coherent: the lane that meets a tile next may be another one.
layout(std430, set = 0, binding = 1) coherent buffer Tiles { uint tiles[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer Instances { uvec2 instances[]; };
layout(std430, set = 0, binding = 4) writeonly buffer SlotRanges { uvec2 slot_ranges[]; };

const uint MOST_LANES = 32u;

shared uint widths[MOST_LANES];
// The next Gaussians, one per lane: fetched together, they are waited for once.
shared Spans fetched[MOST_LANES];

void main() {
    // Everything is done in the first round.
    if (push.pass > 0u) return;
    uint own = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x, lanes = gl_WorkGroupSize.x;
    uint base = own * frame.window.x * frame.window.y, origin = FETCH(starts, int(push.first)).x, slot = 0u;
    Walk w = walk_begin(own, status.visible);
    for (uint b = 0u; b < own; b++) slot += status.lane_instances[b];
    for (uint i = w.i; i < w.end; i++) {
        uint ahead = (i - w.i) % lanes;
        if (ahead == 0u) {
            barrier();
            if (i + lane < w.end) {
                int at = int(FETCH(order, int(i + lane)).x) * 3;
                fetched[lane] = spans_of(FETCH(projected, at), FETCH(projected, at + 2));
            }
            barrier();
        }
        Spans s = fetched[ahead];
        uint begin = slot;
        for (int top = s.row; top <= s.last_row; top += int(lanes)) {
            int row = top + int(lane);
            ivec2 span = ivec2(0, -1);
            if (row <= s.last_row) span = span_in_band(s, row);
            widths[lane] = uint(max(span.y - span.x + 1, 0));
            barrier();
            uint before = slot;
            for (uint b = 0u; b < lanes; b++) {
                before += b < lane ? widths[b] : 0u;
                slot += widths[b];
            }
            for (int x = span.x; x <= span.y; x++) {
                uint t = uint(row) * frame.window.x + uint(x), rank = tiles[base + t];
                tiles[base + t] = rank + 1u;
                instances[FETCH(starts, int(t)).x - origin + rank] = uvec2(i, before + uint(x - span.x));
            }
            memoryBarrierBuffer();
            barrier();
        }
        if (lane == 0u) slot_ranges[i] = uvec2(begin, slot - begin);
    }
}
