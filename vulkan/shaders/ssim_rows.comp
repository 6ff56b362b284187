#version 450
// SSIM, first pass: along rows, the window's means of x, y, x2+y2 and xy for each channel (x rendered with exposure,
// y target; what is left out counts as rendered right). SSIM only ever needs the sum of the two variances.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "window.glsl"

TEXELS(vec4, 9, image)
TEXELS(uvec2, 10, target)
layout(std430, set = 0, binding = 1) writeonly buffer Moments { vec4 moments[]; };

void main() {
    // Uniforms before any branch: behind one, llvmpipe gathers them lane by lane.
    vec3 gain = frame.exposure_gain, offset = frame.exposure_offset;
    uvec2 size = frame.size;
    uint strips = (size.x + uint(STRIP) - 1u) / uint(STRIP), i = gl_GlobalInvocationID.x;
    if (i >= strips * size.y) return;
    int width = int(size.x), row = int(i / strips), strip = int(i % strips) * STRIP;
    uint pixels = size.x * size.y;
    PARTS(first) {
        int x0 = strip + first;
        // Exactly these sums: a compiler that factors the taps out of them would do it another way for other parts.
        precise vec4 sum[3 * PART];
        [[unroll]] for (int k = 0; k < 3 * PART; k++) sum[k] = vec4(0.0);
        [[unroll]] for (int j = -RADIUS; j < PART + RADIUS; j++) {
            int x = x0 + j;
            bool inside = x >= 0 && x < width;
            vec3 a = vec3(0.0), b = vec3(0.0);
            // Fetched in any case, from inside the row: cheaper than a branch.
            int at = row * width + clamp(x, 0, width - 1);
            vec3 shown = FETCH(image, at).xyz * gain + offset;
            uint texel = FETCH(target, at).x;
            vec3 wanted = left_out(texel) ? shown : unpackUnorm4x8(texel).xyz;
            a = inside ? shown : a;
            b = inside ? wanted : b;
            [[unroll]] for (int c = 0; c < 3; c++) {
                vec4 v = vec4(a[c], b[c], fma(a[c], a[c], b[c] * b[c]), a[c] * b[c]);
                [[unroll]] for (int o = 0; o < PART; o++) {
                    if (abs(j - o) <= RADIUS) sum[c * PART + o] = fma(vec4(tap(j - o)), v, sum[c * PART + o]);
                }
            }
        }
        [[unroll]] for (int o = 0; o < PART; o++) {
            if (x0 + o < width) {
                uint at = uint(row * width + x0 + o);
                [[unroll]] for (int c = 0; c < 3; c++) moments[uint(c) * pixels + at] = sum[c * PART + o];
            }
        }
    }
}
