#version 450
// The depth sort, middle: where each block's first key of each digit goes. One workgroup of 256 lanes, one per digit.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) buffer Histogram { uint histogram[]; };
layout(std430, set = 0, binding = 2) buffer StatusWords { Status status; };

// Shares whose counts are read before any is written: one after the other, each would wait for the one before (an H100: 0.45 ms a
// sort of any size).
const uint AHEAD = 8u;

shared uint totals[256];

void main() {
    uint digit = gl_LocalInvocationID.x;
    uint sum = 0u;
    uint counts[AHEAD];
    for (uint b = 0u; b < SORT_LANES; b += AHEAD) {
        [[unroll]] for (uint k = 0u; k < AHEAD; k++) counts[k] = histogram[(b + k) * 256u + digit];
        [[unroll]] for (uint k = 0u; k < AHEAD; k++) {
            histogram[(b + k) * 256u + digit] = sum;
            sum += counts[k];
        }
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
    for (uint b = 0u; b < SORT_LANES; b += AHEAD) {
        [[unroll]] for (uint k = 0u; k < AHEAD; k++) counts[k] = histogram[(b + k) * 256u + digit];
        [[unroll]] for (uint k = 0u; k < AHEAD; k++) histogram[(b + k) * 256u + digit] = base + counts[k];
    }
}
