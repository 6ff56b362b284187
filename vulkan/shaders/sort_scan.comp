#version 450
// The depth sort, middle: where each block's first key of each digit goes. One workgroup of 256 lanes, one per digit.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) buffer Histogram { uint histogram[]; };
layout(std430, set = 0, binding = 2) buffer StatusWords { Status status; };

shared uint totals[256];

void main() {
    uint digit = gl_LocalInvocationID.x;
    uint sum = 0u;
    for (uint b = 0u; b < SORT_LANES; b++) {
        uint count = histogram[b * 256u + digit];
        histogram[b * 256u + digit] = sum;
        sum += count;
    }
    totals[digit] = sum;
    barrier();
    if (digit == 0u) {
        uint running = 0u;
        for (uint d = 0u; d < 256u; d++) {
            uint count = totals[d];
            totals[d] = running;
            running += count;
        }
        if (push.pass == 0u) status.visible = running;
    }
    barrier();
    uint base = totals[digit];
    for (uint b = 0u; b < SORT_LANES; b++) histogram[b * 256u + digit] += base;
}
