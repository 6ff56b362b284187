#version 450
// Pearson depth, second pass: merges the lanes' moments in order (Chan et al.) and leaves the correlation and the line
// on which its gradient lies: dL/dD = k_e E + k_d D + k_0. Constant depth or fewer than three pixels: no gradient.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer LaneSums { DepthMoments lane_sums[]; };
layout(std430, set = 0, binding = 2) buffer StatusWords { Status status; };

void main() {
    if (gl_GlobalInvocationID.x != 0u) return;
    float n = 0.0, mean_d = 0.0, mean_e = 0.0, dd = 0.0, ee = 0.0, de = 0.0;
    for (uint lane = 0u; lane < LOOP_LANES; lane++) {
        DepthMoments own = lane_sums[lane];
        if (own.count > 0.0) {
            float both = n + own.count, share = own.count / both;
            float by_d = own.mean_d - mean_d, by_e = own.mean_e - mean_e;
            mean_d += by_d * share;
            mean_e += by_e * share;
            float weight = n * share;
            dd += own.square_d + by_d * by_d * weight;
            ee += own.square_e + by_e * by_e * weight;
            de += own.product + by_d * by_e * weight;
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
        line.x = -frame.depth_weight * both;
        line.y = frame.depth_weight * correlation / dd;
        line.z = -(line.x * mean_e + line.y * mean_d);
    }
    status.depth_by_prior = line.x;
    status.depth_by_rendered = line.y;
    status.depth_constant = line.z;
    status.correlation = correlation;
    status.correlates = useful ? 1u : 0u;
}
