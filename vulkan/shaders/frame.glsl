// What every kernel includes: the constants, what it shares with the host, the hash and the sigmoid.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "constants.glsl"

// Chosen per device: lanes of a workgroup, columns of SH (vec4) and the highest degree they hold, sorting lanes,
// lanes of the loops over visible Gaussians; per job: whether Gaussians have SH
// degrees of their own, and whether the moments of SH are kept in 16 bits.
layout(local_size_x_id = 0, local_size_y = 1, local_size_z = 1) in;
layout(constant_id = 1) const uint SH_COLUMNS = 12;
layout(constant_id = 2) const uint SH_DEGREE = 3;
layout(constant_id = 3) const uint SORT_LANES = 32;
layout(constant_id = 4) const uint LOOP_LANES = 1024;
layout(constant_id = 5) const bool OWN_DEGREES = false;
layout(constant_id = 6) const bool HALF_MOMENTS = false;

#include "layout.glsl"

// What a kernel only reads, it fetches as texels (src/pipelines.rs says why); with STORAGE_READS, for devices whose texel
// views are smaller than the plan's sections, it reads the same from storage buffers.
#ifdef STORAGE_READS
#define TEXELS(type, number, name) layout(std430, set = 0, binding = number) readonly buffer Read_##name { type name[]; };
#define FETCH(name, i) name[i]
#else
#define TEXELS(type, number, name) layout(set = 0, binding = number) uniform TEXELS_##type name;
#define TEXELS_vec4 samplerBuffer
#define TEXELS_uvec2 usamplerBuffer
#define TEXELS_uint usamplerBuffer
#define FETCH(name, i) texelFetch(name, i)
#endif

// In place of a confidence, in the pictures and in the step's target: the pixel is left out of every comparison.
const uint LEFT_OUT = 1u;

bool left_out(uint texel) {
    return texel >> 24 == LEFT_OUT;
}

// PCG hash (Jarzynski & Olano 2020): same numbers on every device.
uint pcg(uint v) {
    uint s = v * 747796405u + 2891336453u;
    uint w = ((s >> ((s >> 28u) + 4u)) ^ s) * 277803737u;
    return (w >> 22u) ^ w;
}

// Uniform in [0, 1), a function of the seed, the step, a Gaussian and a channel only.
float uniform_hash(uint gaussian, uint channel) {
    uint h = pcg(gaussian + pcg(frame.step + pcg(frame.seed + channel * 0x9E3779B9u)));
    return float(h >> 8) * (1.0 / 16777216.0);
}

float sigmoid(float x) {
    return 1.0 / (1.0 + exp(-x));
}
