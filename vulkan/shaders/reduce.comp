#version 450
// Sums each visible Gaussian's gradient slots in tile order, one lane per Gaussian. Mode 1 adds to the sum of earlier bands: one running sum
// either way, so that the number of bands does not change a bit.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

TEXELS(uvec2, 9, slot_ranges)
TEXELS(vec4, 10, slots)
layout(std430, set = 0, binding = 1) buffer Reduced { vec4 reduced[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };

// llvmpipe ends the loops of an invocation after 65,535 turns in all: a Gaussian over more tiles takes sixteen in a turn.
const uint ONE_BY_ONE = 30000u;
const uint AT_ONCE = 16u;

void add_slot(uint i, inout vec4 a, inout vec4 b, inout vec4 c) {
    int at = int(i) * 3;
    vec4 x = FETCH(slots, at), y = FETCH(slots, at + 1), z = FETCH(slots, at + 2);
    bool written = x.w > 0.0;
    a += x;
    b += written ? y : vec4(0.0);
    c += written ? z : vec4(0.0);
}

void main() {
    uint r = gl_GlobalInvocationID.x;
    if (r >= status.visible) return;
    vec4 a = vec4(0.0), b = vec4(0.0), c = vec4(0.0);
    if (push.mode == 1u) {
        a = reduced[r * 3];
        b = reduced[r * 3 + 1];
        c = reduced[r * 3 + 2];
    }
    uvec2 range = FETCH(slot_ranges, int(r)).xy;
    uint i = range.x, end = range.x + range.y, near = min(end, range.x + ONE_BY_ONE);
    for (; i < near; i++) add_slot(i, a, b, c);
    for (; i < end; i += AT_ONCE) {
        [[unroll]] for (uint j = 0u; j < AT_ONCE; j++) {
            if (i + j < end) add_slot(i + j, a, b, c);
        }
    }
    reduced[r * 3] = a;
    reduced[r * 3 + 1] = b;
    reduced[r * 3 + 2] = c;
}
