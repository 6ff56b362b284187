#version 450
// Sums each visible Gaussian's gradient slots in tile order, one lane per Gaussian. Mode 1 adds to the sum of earlier bands: one running sum
// either way, so that the number of bands does not change a bit.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(set = 0, binding = 9) uniform usamplerBuffer slot_ranges;
layout(set = 0, binding = 10) uniform samplerBuffer slots;
layout(std430, set = 0, binding = 1) buffer Reduced { vec4 reduced[]; };
layout(std430, set = 0, binding = 2) readonly buffer Status { uint status[]; };

void main() {
    uint r = gl_GlobalInvocationID.x;
    if (r >= status[0]) return;
    vec4 a = vec4(0.0), b = vec4(0.0), c = vec4(0.0);
    if (push.mode == 1u) {
        a = reduced[r * 3];
        b = reduced[r * 3 + 1];
        c = reduced[r * 3 + 2];
    }
    uvec2 range = texelFetch(slot_ranges, int(r)).xy;
    uint end = range.x + range.y;
    for (uint i = range.x; i < end; i++) {
        int at = int(i) * 3;
        vec4 x = texelFetch(slots, at), y = texelFetch(slots, at + 1), z = texelFetch(slots, at + 2);
        bool written = x.w > 0.0;
        a += x;
        b += written ? y : vec4(0.0);
        c += written ? z : vec4(0.0);
    }
    reduced[r * 3] = a;
    reduced[r * 3 + 1] = b;
    reduced[r * 3 + 2] = c;
}
