#version 450
// First instance of every tile: an exclusive prefix sum by one workgroup of 256 lanes, modulo 2^32 (a band's instances
// are a difference of two starts and fit). The total saturates, so that more than 2^32 instances are not taken for few.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) buffer Starts { uint starts[]; };
layout(std430, set = 0, binding = 2) buffer StatusWords { Status status; };

shared uint totals[256];

uint saturating(uint a, uint b) {
    uint carry;
    uint sum = uaddCarry(a, b, carry);
    return carry != 0u ? 0xFFFFFFFFu : sum;
}

void main() {
    uint lane = gl_LocalInvocationID.x, n = frame.window.x * frame.window.y;
    uint share = (n + 255u) / 256u, first = min(lane * share, n), end = min(first + share, n);
    uint sum = 0u;
    for (uint t = first; t < end; t++) sum += starts[t];
    totals[lane] = sum;
    barrier();
    if (lane == 0u) {
        uint running = 0u, all = 0u;
        for (uint b = 0u; b < 256u; b++) {
            uint count = totals[b];
            totals[b] = running;
            running += count;
            all = saturating(all, count);
        }
        starts[n] = running;
        status.instances = all;
    }
    barrier();
    uint running = totals[lane];
    for (uint t = first; t < end; t++) {
        uint count = starts[t];
        starts[t] = running;
        running += count;
    }
}
