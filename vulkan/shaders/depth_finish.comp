#version 450
// Pearson depth, second pass: merges the lanes' moments in order (Chan et al.) and leaves the correlation and the line
// on which its gradient lies: dL/dD = k_e E + k_d D + k_0. Constant depth or fewer than three pixels: no gradient.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer Partials { vec4 partials[]; };
layout(std430, set = 0, binding = 2) buffer Status { uint status[]; };

void main() {
    if (gl_GlobalInvocationID.x != 0u) return;
    float n = 0.0, mean_d = 0.0, mean_e = 0.0, dd = 0.0, ee = 0.0, de = 0.0;
    for (uint lane = 0u; lane < LOOP_LANES; lane++) {
        vec4 a = partials[lane * 2u], b = partials[lane * 2u + 1u];
        if (a.x > 0.0) {
            float both = n + a.x, share = a.x / both;
            float by_d = a.y - mean_d, by_e = a.z - mean_e;
            mean_d += by_d * share;
            mean_e += by_e * share;
            float weight = n * share;
            dd += b.x + by_d * by_d * weight;
            ee += b.y + by_e * by_e * weight;
            de += b.z + by_d * by_e * weight;
            n = both;
        }
    }
    vec3 line = vec3(0.0);
    float correlation = 0.0;
    bool useful = n >= 3.0 && dd > PEARSON_EPSILON * (n * mean_d * mean_d + 1.0e-12) && ee > PEARSON_EPSILON * n;
    if (useful) {
        float both = inversesqrt(dd) * inversesqrt(ee);
        correlation = de * both;
        // The loss is one minus the correlation.
        line.x = -frame.exposure_offset.w * both;
        line.y = frame.exposure_offset.w * correlation / dd;
        line.z = -(line.x * mean_e + line.y * mean_d);
    }
    status[512] = floatBitsToUint(line.x);
    status[513] = floatBitsToUint(line.y);
    status[514] = floatBitsToUint(line.z);
    status[515] = floatBitsToUint(correlation);
    status[516] = useful ? 1u : 0u;
}
