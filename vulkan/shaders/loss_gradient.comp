#version 450
// The loss's gradient at every pixel: L1, SSIM (second pass of its gradient, along columns) and Pearson depth; the
// value of L1 is left as one partial sum per strip.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "window.glsl"

TEXELS(vec4, 9, blurred)
TEXELS(vec4, 10, image)
TEXELS(uvec2, 11, target)
layout(std430, set = 0, binding = 1) writeonly buffer ImageGradient { vec4 image_gradient[]; };
layout(std430, set = 0, binding = 2) writeonly buffer StripSums { LossSums strip_sums[]; };
layout(std430, set = 0, binding = 3) readonly buffer StatusWords { Status status; };

void main() {
    // Before any branch, as in ssim_rows.comp.
    vec3 gain = frame.exposure_gain, offset = frame.exposure_offset;
    float l1_weight = frame.l1_weight, ssim_weight = frame.ssim_weight, min_confidence = frame.min_confidence;
    uint width = frame.size.x, i = gl_GlobalInvocationID.x;
    int height = int(frame.size.y);
    if (i >= width * uint((height + STRIP - 1) / STRIP)) return;
    uint column = i % width, pixels = width * uint(height);
    int strip = int(i / width) * STRIP;
    float l1 = 0.0;
    PARTS(first) {
        int y0 = strip + first;
        vec3 by_mean[PART], by_square[PART], by_product[PART];
        [[unroll]] for (int o = 0; o < PART; o++) {
            by_mean[o] = vec3(0.0);
            by_square[o] = vec3(0.0);
            by_product[o] = vec3(0.0);
        }
        [[unroll]] for (int j = -RADIUS; j < PART + RADIUS; j++) {
            int y = y0 + j;
            [[unroll]] for (int c = 0; c < 3; c++) {
                vec3 v = FETCH(blurred, c * int(pixels) + clamp(y, 0, height - 1) * int(width) + int(column)).xyz;
                v = y >= 0 && y < height ? v : vec3(0.0);
                [[unroll]] for (int o = 0; o < PART; o++) {
                    if (abs(j - o) <= RADIUS) {
                        by_mean[o][c] = fma(tap(j - o), v.x, by_mean[o][c]);
                        by_square[o][c] = fma(tap(j - o), v.y, by_square[o][c]);
                        by_product[o][c] = fma(tap(j - o), v.z, by_product[o][c]);
                    }
                }
            }
        }
        [[unroll]] for (int o = 0; o < PART; o++) {
            if (y0 + o < height) {
                uint at = uint(y0 + o) * width + column;
                vec4 raw = FETCH(image, int(at));
                uvec2 wanted = FETCH(target, int(at)).xy;
                vec4 y = unpackUnorm4x8(wanted.x);
                vec3 x = raw.xyz * gain + offset;
                bool compared = !left_out(wanted.x);
                vec3 d = compared ? x - y.xyz : vec3(0.0);
                l1 += abs(d.x) + abs(d.y) + abs(d.z);
                vec3 g = l1_weight * sign(d)
                    - ssim_weight * (by_mean[o] + 2.0 * x * by_square[o] + y.xyz * by_product[o]);
                g = compared ? g : vec3(0.0);
                float depth = 0.0;
                if ((frame.flags & FLAG_DEPTH) != 0u && compared && y.w > 0.0 && y.w >= min_confidence) {
                    vec3 line = vec3(status.depth_by_prior, status.depth_by_rendered, status.depth_constant);
                    depth = line.x * float(wanted.y) * (1.0 / 65535.0) + line.y * raw.w + line.z;
                }
                image_gradient[at] = vec4(g * gain, depth);
            }
        }
    }
    strip_sums[i].l1 = l1;
}
