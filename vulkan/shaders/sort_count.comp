#version 450
// One pass of the depth sort, first half: each lane counts the digits of its own contiguous block (no barrier, no
// atomic: what software devices like, and stable by construction). Pass 0 also leaves out what is not visible.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer Keys { uint keys[]; };
layout(std430, set = 0, binding = 2) buffer Histogram { uint histogram[]; };
layout(std430, set = 0, binding = 3) readonly buffer StatusWords { Status status; };

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= SORT_LANES) return;
    uint n = push.pass == 0u ? frame.gaussians : status.visible;
    uint share = (n + SORT_LANES - 1u) / SORT_LANES;
    uint i = lane * share, end = min(i + share, n), shift = push.pass * 8u;
    for (uint d = 0u; d < 256u; d++) histogram[lane * 256u + d] = 0u;
    for (; i < end; i++) {
        uint key = keys[i];
        if (key != 0xFFFFFFFFu) histogram[lane * 256u + ((key >> shift) & 255u)] += 1u;
    }
}
