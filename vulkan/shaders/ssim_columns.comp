#version 450
// SSIM, second pass: along columns, then SSIM itself and its derivatives by the mean of x, by the mean of x2+y2 and by
// the mean of xy, per pixel and channel.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "window.glsl"

TEXELS(vec4, 9, moments)
layout(std430, set = 0, binding = 1) writeonly buffer Adjoint { Texel adjoint[]; };
layout(std430, set = 0, binding = 2) writeonly buffer StripSums { LossSums strip_sums[]; };

void main() {
    uint width = frame.size.x, i = gl_GlobalInvocationID.x;
    int height = int(frame.size.y);
    if (i >= width * uint((height + STRIP - 1) / STRIP)) return;
    uint column = i % width, pixels = width * uint(height);
    int strip = int(i / width) * STRIP;
    float total = 0.0;
    [[unroll]] for (uint c = 0u; c < 3u; c++) {
        PARTS(first) {
            int y0 = strip + first;
            vec4 sum[PART];
            [[unroll]] for (int o = 0; o < PART; o++) sum[o] = vec4(0.0);
            [[unroll]] for (int j = -RADIUS; j < PART + RADIUS; j++) {
                int y = y0 + j;
                vec4 v = FETCH(moments, int(c * pixels + column) + clamp(y, 0, height - 1) * int(width));
                v = y >= 0 && y < height ? v : vec4(0.0);
                [[unroll]] for (int o = 0; o < PART; o++) {
                    if (abs(j - o) <= RADIUS) sum[o] = fma(vec4(tap(j - o)), v, sum[o]);
                }
            }
            [[unroll]] for (int o = 0; o < PART; o++) {
                float ma = sum[o].x, mb = sum[o].y, cross2 = 2.0 * ma * mb, square = ma * ma + mb * mb;
                // Rounding may make a variance negative, or the covariance larger than both: far beyond colours of 1 the
                // denominator would otherwise reach zero.
                float variances = max(sum[o].z - square, 0.0);
                float a1 = cross2 + SSIM_C1, a2 = clamp(2.0 * sum[o].w - cross2, -variances, variances) + SSIM_C2;
                float b1 = square + SSIM_C1, b2 = variances + SSIM_C2;
                float r1 = 1.0 / b1, r2 = 1.0 / b2, both = r1 * r2, s = a1 * a2 * both;
                vec3 d = vec3(2.0 * mb * (a2 - a1) * both + 2.0 * ma * s * (r2 - r1), -s * r2, 2.0 * a1 * both);
                if (y0 + o < height) {
                    adjoint[c * pixels + uint(y0 + o) * width + column].value = d;
                    total += s;
                }
            }
        }
    }
    strip_sums[i].ssim = total;
}
