#version 450
// Counts instances per tile. Each lane walks its own contiguous share of the Gaussians in depth order and keeps its own
// histogram. Mode 1 counts only the total inside a band (the histogram is there already).
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "spans.glsl"
#include "walk.glsl"

TEXELS(vec4, 9, projected)
TEXELS(uint, 10, order)
layout(std430, set = 0, binding = 1) buffer Tiles { uint tiles[]; };
layout(std430, set = 0, binding = 2) buffer StatusWords { Status status; };

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= SORT_LANES) return;
    uint tile_count = frame.window.x * frame.window.y, total = 0u, base = lane * tile_count;
    Walk w = walk_begin(lane, status.visible);
    if (push.pass > 0u) {
        w.i = status.cursors[lane].gaussian;
        w.row = status.cursors[lane].row;
        total = status.lane_instances[lane];
    }
    // One loop over all tiles of all Gaussians, not a loop in a loop in a loop: lanes in lockstep would wait in each for
    // the one with the largest Gaussian.
    Spans s;
    ivec2 span = ivec2(0, -1); // tiles of the present row that remain
    uint line = 0u;
    bool open = false;
    while (span.x <= span.y || (w.i < w.end && w.left > 0u)) {
        if (span.x > span.y) {
            if (!open) {
                int at = int(FETCH(order, int(w.i)).x) * 3;
                s = spans_of(FETCH(projected, at), FETCH(projected, at + 2));
                if (w.row >= 0) s.row = w.row;
                open = true;
            }
            if (s.row <= s.last_row) {
                span = span_in_band(s, s.row);
                line = base + uint(s.row) * frame.window.x;
                total += uint(max(span.y - span.x + 1, 0));
                if (push.mode == 1u) span.y = span.x - 1;
                s.row++;
            }
            open = s.row <= s.last_row;
            w.row = open ? s.row : -1;
            w.i += open ? 0u : 1u;
        }
        if (span.x <= span.y) {
            tiles[line + uint(span.x)] += 1u;
            span.x++;
        }
        walk_pay(w);
    }
    status.lane_instances[lane] = total;
    status.lane_counted[lane] = w.i >= w.end ? 1u : 0u;
    status.cursors[lane].gaussian = w.i;
    status.cursors[lane].row = w.row;
}
