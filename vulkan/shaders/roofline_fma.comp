#version 450
// What the device can compute: sixteen independent chains of fused multiply-adds per lane, unrolled, nothing else.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x_id = 0, local_size_y = 1, local_size_z = 1) in;
layout(set = 0, binding = 0) uniform samplerBuffer source;
layout(std430, set = 0, binding = 1) writeonly buffer Into { vec4 into[]; };
layout(push_constant) uniform Push { uint count; uint turns; } push;

const int CHAINS = 16;
const int UNROLLED = 8;

void main() {
    uint lane = gl_GlobalInvocationID.x;
    // Unknown to the compiler, so that nothing can be folded; below 1, so that nothing overflows.
    vec4 seed = texelFetch(source, int(lane % push.count));
    float a = 0.999 + 1e-6 * seed.x, b = 1e-3 * seed.y, x[CHAINS];
    [[unroll]] for (int k = 0; k < CHAINS; k++) x[k] = seed.z + float(k);
    for (uint turn = 0u; turn < push.turns; turn++) {
        [[unroll]] for (int u = 0; u < UNROLLED; u++) {
            [[unroll]] for (int k = 0; k < CHAINS; k++) x[k] = fma(x[k], a, b);
        }
    }
    float sum = 0.0;
    [[unroll]] for (int k = 0; k < CHAINS; k++) sum += x[k];
    into[lane % push.count] = vec4(sum);
}
