#version 450
// One pass of the depth sort, second half: each lane moves its block's keys and rows, in order.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer KeysIn { uint keys_in[]; };
layout(std430, set = 0, binding = 2) readonly buffer RowsIn { uint rows_in[]; };
layout(std430, set = 0, binding = 3) writeonly buffer KeysOut { uint keys_out[]; };
layout(std430, set = 0, binding = 4) writeonly buffer RowsOut { uint rows_out[]; };
layout(std430, set = 0, binding = 5) buffer Histogram { uint histogram[]; };
layout(std430, set = 0, binding = 6) readonly buffer StatusWords { Status status; };

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= SORT_LANES) return;
    uint n = push.pass == 0u ? frame.gaussians : status.visible;
    uint share = (n + SORT_LANES - 1u) / SORT_LANES;
    uint i = lane * share, end = min(i + share, n), shift = push.pass * 8u;
    for (; i < end; i++) {
        uint key = keys_in[i];
        if (key != 0xFFFFFFFFu) {
            uint row = i;
            if (push.pass != 0u) row = rows_in[i];
            uint slot = lane * 256u + ((key >> shift) & 255u);
            uint to = histogram[slot];
            histogram[slot] = to + 1u;
            keys_out[to] = key;
            rows_out[to] = row;
        }
    }
}
