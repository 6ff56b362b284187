#version 450
// SSIM's gradient, first pass: the window over the derivatives, along rows.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "window.glsl"

TEXELS(vec4, 9, adjoint)
layout(std430, set = 0, binding = 1) writeonly buffer Blurred { Texel blurred[]; };

void main() {
    uvec2 size = frame.size;
    uint strips = (size.x + uint(STRIP) - 1u) / uint(STRIP), i = gl_GlobalInvocationID.x;
    if (i >= strips * size.y) return;
    int width = int(size.x), row = int(i / strips), strip = int(i % strips) * STRIP;
    uint pixels = size.x * size.y;
    PARTS(first) {
        int x0 = strip + first;
        [[unroll]] for (uint c = 0u; c < 3u; c++) {
            vec3 sum[PART];
            [[unroll]] for (int o = 0; o < PART; o++) sum[o] = vec3(0.0);
            [[unroll]] for (int j = -RADIUS; j < PART + RADIUS; j++) {
                int x = x0 + j;
                vec3 v = FETCH(adjoint, int(c * pixels) + row * width + clamp(x, 0, width - 1)).xyz;
                v = x >= 0 && x < width ? v : vec3(0.0);
                [[unroll]] for (int o = 0; o < PART; o++) {
                    if (abs(j - o) <= RADIUS) sum[o] = fma(vec3(tap(j - o)), v, sum[o]);
                }
            }
            [[unroll]] for (int o = 0; o < PART; o++) {
                if (x0 + o < width) blurred[c * pixels + uint(row * width + x0 + o)].value = sum[o];
            }
        }
    }
}
