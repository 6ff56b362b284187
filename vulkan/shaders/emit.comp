#version 450
// Writes every (Gaussian, tile) instance of the band to its place in the tile's list, in depth order, and gives it a
// gradient slot; a Gaussian's slots are consecutive and in tile order.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "spans.glsl"
#include "walk.glsl"

layout(set = 0, binding = 9) uniform samplerBuffer projected;
layout(set = 0, binding = 10) uniform usamplerBuffer order;
layout(std430, set = 0, binding = 1) buffer Tiles { uint tiles[]; };
layout(std430, set = 0, binding = 2) readonly buffer Starts { uint starts[]; };
layout(std430, set = 0, binding = 3) buffer Status { uint status[]; };
layout(std430, set = 0, binding = 4) writeonly buffer Instances { uvec2 instances[]; };
layout(std430, set = 0, binding = 5) writeonly buffer SlotRanges { uvec2 slot_ranges[]; };

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= SORT_BLOCKS) return;
    uint tile_count = frame.window.z * frame.window.w, base = lane * tile_count, origin = starts[push.first];
    uint cursor = WALK_CURSORS + lane * 4u, slot = 0u, begin;
    Walk w = walk_begin(lane, status[0]);
    for (uint b = 0u; b < lane; b++) slot += status[16u + b];
    begin = slot;
    if (push.pass > 0u) {
        w.i = status[cursor];
        w.row = int(status[cursor + 1u]);
        slot = status[cursor + 2u];
        begin = status[cursor + 3u];
    }
    while (w.i < w.end && w.left > 0u) {
        int at = int(texelFetch(order, int(w.i)).x) * 3;
        Spans s = spans_of(texelFetch(projected, at), texelFetch(projected, at + 2));
        if (w.row >= 0) s.row = w.row;
        for (; s.row <= s.last_row && w.left > 0u; s.row++) {
            ivec2 span = span_in_band(s, s.row);
            uint row = uint(s.row) * frame.window.z;
            for (int x = span.x; x <= span.y; x++) {
                uint t = row + uint(x), rank = tiles[base + t];
                tiles[base + t] = rank + 1u;
                instances[starts[t] - origin + rank] = uvec2(w.i, slot);
                slot++;
            }
            walk_pay(w, uint(max(span.y - span.x + 1, 0)) + 1u);
        }
        bool finished = s.row > s.last_row;
        if (finished) {
            slot_ranges[w.i] = uvec2(begin, slot - begin);
            begin = slot;
        }
        w.row = finished ? -1 : s.row;
        w.i += finished ? 1u : 0u;
        walk_pay(w, 1u);
    }
    status[cursor] = w.i;
    status[cursor + 1u] = uint(w.row);
    status[cursor + 2u] = slot;
    status[cursor + 3u] = begin;
}
