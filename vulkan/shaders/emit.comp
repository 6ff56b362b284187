#version 450
// Writes every (Gaussian, tile) instance of the band to its place in the tile's list, in depth order, and gives it a
// gradient slot; a Gaussian's slots are consecutive and in tile order.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "spans.glsl"
#include "walk.glsl"

TEXELS(vec4, 9, projected)
TEXELS(uint, 10, order)
TEXELS(uint, 11, starts)
layout(std430, set = 0, binding = 1) buffer Tiles { uint tiles[]; };
layout(std430, set = 0, binding = 2) buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer Instances { uvec2 instances[]; };
layout(std430, set = 0, binding = 4) writeonly buffer SlotRanges { uvec2 slot_ranges[]; };

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= SORT_LANES) return;
    uint tile_count = frame.window.x * frame.window.y, base = lane * tile_count, origin = FETCH(starts, int(push.first)).x;
    uint slot = 0u, begin;
    Walk w = walk_begin(lane, status.visible);
    for (uint b = 0u; b < lane; b++) slot += status.lane_instances[b];
    begin = slot;
    if (push.pass > 0u) {
        w.i = status.cursors[lane].gaussian;
        w.row = status.cursors[lane].row;
        slot = status.cursors[lane].slot;
        begin = status.cursors[lane].first_slot;
    }
    // One loop, as in count.comp.
    Spans s;
    ivec2 span = ivec2(0, -1);
    uint line = 0u, gaussian = 0u;
    bool open = false;
    while (span.x <= span.y || (w.i < w.end && w.left > 0u)) {
        if (span.x > span.y) {
            if (!open) {
                int at = int(FETCH(order, int(w.i)).x) * 3;
                s = spans_of(FETCH(projected, at), FETCH(projected, at + 2));
                if (w.row >= 0) s.row = w.row;
                open = true;
            }
            gaussian = w.i;
            uint touched = 0u;
            if (s.row <= s.last_row) {
                span = span_in_band(s, s.row);
                line = uint(s.row) * frame.window.x;
                touched = uint(max(span.y - span.x + 1, 0));
                s.row++;
            }
            open = s.row <= s.last_row;
            w.row = open ? s.row : -1;
            if (!open) {
                uint end = slot + touched;
                slot_ranges[gaussian] = uvec2(begin, end - begin);
                begin = end;
                w.i++;
            }
        }
        if (span.x <= span.y) {
            uint t = line + uint(span.x), rank = tiles[base + t];
            tiles[base + t] = rank + 1u;
            instances[FETCH(starts, int(t)).x - origin + rank] = uvec2(gaussian, slot);
            slot++;
            span.x++;
        }
        walk_pay(w);
    }
    status.cursors[lane].gaussian = w.i;
    status.cursors[lane].row = w.row;
    status.cursors[lane].slot = slot;
    status.cursors[lane].first_slot = begin;
}
