#version 450
// As sort_count.comp, with a workgroup of 256 lanes instead of one lane for each share: for devices with many lanes and a
// long way to their memory. Counting is a sum of integers, so that the order of the atomics does not matter.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer Keys { uint keys[]; };
layout(std430, set = 0, binding = 2) writeonly buffer Histogram { uint histogram[]; };
layout(std430, set = 0, binding = 3) readonly buffer StatusWords { Status status; };

shared uint counts[256];

void main() {
    uint own = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
    uint n = push.pass == 0u ? frame.gaussians : status.visible;
    uint share = (n + SORT_LANES - 1u) / SORT_LANES, first = own * share, end = min(first + share, n), shift = push.pass * 8u;
    counts[lane] = 0u;
    barrier();
    for (uint i = first + lane; i < end; i += 256u) {
        uint key = keys[i];
        if (key != 0xFFFFFFFFu) atomicAdd(counts[(key >> shift) & 255u], 1u);
    }
    barrier();
    histogram[own * 256u + lane] = counts[lane];
}
