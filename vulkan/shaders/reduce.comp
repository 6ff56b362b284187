#version 450
// Sums each visible Gaussian's gradient slots in tile order, one lane per Gaussian. Mode 1 adds to the sum of earlier bands: one running sum
// either way, so that the number of bands does not change a bit.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

TEXELS(uvec2, 9, slot_ranges)
TEXELS(vec4, 10, slots)
TEXELS(vec4, 11, shaded)
struct Sums {
    vec4 line, square;
    vec3 colour;
};
layout(std430, set = 0, binding = 1) buffer Reduced { Sums reduced[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };

// llvmpipe ends the loops of an invocation after 65,535 turns in all: a Gaussian over more tiles takes sixteen in a turn.
const uint ONE_BY_ONE = 30000u;
const uint AT_ONCE = 16u;

// A slot holds a depth gradient only where the view has a depth prior.
void add_slot(uint i, float depth, inout vec4 a, inout vec4 b, inout vec3 c) {
    int at = int(i) * 3;
    vec4 x = FETCH(slots, at), y = FETCH(slots, at + 1);
    vec3 z = FETCH(slots, at + 2).xyz;
    y.w = depth > 0.0 ? y.w : 0.0;
    bool written = x.w > 0.0;
    a += x;
    b += written ? y : vec4(0.0);
    c += written ? z : vec3(0.0);
}

void main() {
    float depth = (frame.flags & FLAG_DEPTH) != 0u ? 1.0 : 0.0;
    uint r = gl_GlobalInvocationID.x;
    if (r >= status.visible) return;
    vec4 a = vec4(0.0), b = vec4(0.0);
    vec3 c = vec3(0.0);
    if (push.mode == 1u) {
        a = reduced[r].line;
        b = reduced[r].square;
        c = reduced[r].colour;
    }
    uvec2 range = FETCH(slot_ranges, int(r)).xy;
    uint i = range.x, end = range.x + range.y, near = min(end, range.x + ONE_BY_ONE);
    for (; i < near; i++) add_slot(i, depth, a, b, c);
    for (; i < end; i += AT_ONCE) {
        [[unroll]] for (uint j = 0u; j < AT_ONCE; j++) {
            if (i + j < end) add_slot(i + j, depth, a, b, c);
        }
    }
    // Where the colour was clamped there is no gradient.
    vec3 shown = FETCH(shaded, int(r) * 3 + 2).xyz;
    c = mix(c, vec3(0.0), lessThanEqual(shown, vec3(0.0)));
    c = mix(c, vec3(0.0), greaterThanEqual(shown, vec3(COLOUR_MAX)));
    reduced[r].line = a;
    reduced[r].square = b;
    reduced[r].colour = c;
}
