#version 450
// Pearson depth, first pass: count, means and centred second moments of rendered depth and prior over the confident
// pixels, per lane (Welford), so that no large sums cancel.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer Image { vec4 image[]; };
layout(std430, set = 0, binding = 2) readonly buffer Target { uvec2 target[]; };
layout(std430, set = 0, binding = 3) writeonly buffer LaneSums { DepthMoments lane_sums[]; };

void main() {
    uint lane = gl_GlobalInvocationID.x, pixels = frame.size.x * frame.size.y;
    float n = 0.0, mean_d = 0.0, mean_e = 0.0, dd = 0.0, ee = 0.0, de = 0.0;
    for (uint i = lane; i < pixels; i += LOOP_LANES) {
        uvec2 wanted = target[i];
        float confidence = float(wanted.x >> 24) * (1.0 / 255.0);
        if (confidence > 0.0 && confidence >= frame.min_confidence && !left_out(wanted.x)) {
            float d = image[i].w, e = float(wanted.y) * (1.0 / 65535.0);
            n += 1.0;
            float before = d - mean_d, before_e = e - mean_e;
            mean_d += before / n;
            mean_e += before_e / n;
            dd += before * (d - mean_d);
            ee += before_e * (e - mean_e);
            de += before * (e - mean_e);
        }
    }
    lane_sums[lane] = DepthMoments(n, mean_d, mean_e, dd, ee, de, 0.0, 0.0);
}
