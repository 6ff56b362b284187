#version 450
// The step's picture at working size: blocks of divisor x divisor pixels averaged; alpha is the depth prior's
// confidence, which weighs the depth. Pixels that are left out have no part in it, and a block of them is left out. Of a part of a picture, from its pixel `push.first` on. One lane per pixel.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer View { uint view[]; };
layout(std430, set = 0, binding = 2) writeonly buffer Target { uvec2 target[]; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= frame.size.x * frame.size.y) return;
    uint divisor = frame.divisor, width = frame.source_width, depth_at = frame.depth_offset;
    uvec2 corner = uvec2(i % frame.size.x, i / frame.size.x) * divisor;
    vec4 sum = vec4(0.0);
    float depth = 0.0, seen = 0.0;
    for (uint y = 0u; y < divisor; y++) {
        for (uint x = 0u; x < divisor; x++) {
            uint at = push.first + (corner.y + y) * width + corner.x + x;
            uint texel = view[at];
            if (left_out(texel)) continue;
            vec4 c = unpackUnorm4x8(texel);
            sum += c;
            seen += 1.0;
            if (depth_at != 0u && c.w > 0.0) {
                uint pair = view[depth_at + at / 2u];
                depth += c.w * float((at & 1u) == 0u ? pair & 0xFFFFu : pair >> 16);
            }
        }
    }
    depth = sum.w > 0.0 ? depth / sum.w : 0.0;
    // Where all of a block is left out there is nothing to divide.
    uint texel = packUnorm4x8(sum / max(seen, 1.0));
    // A mean confidence that reads as the mark is next to none.
    if (left_out(texel)) texel &= 0x00FFFFFFu;
    target[i] = uvec2(seen > 0.0 ? texel : LEFT_OUT << 24, uint(depth + 0.5));
}
