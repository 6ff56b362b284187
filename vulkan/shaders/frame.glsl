// The step's constants, one uniform block for every kernel; src/trainer/frame.rs mirrors it field by field.
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

const uint FLAG_FREEZE_SHAPE = 1u;
const uint FLAG_DEPTH = 4u;
// Skips switched off, for the benchmark that says what each is worth; they change no picture.
const uint FLAG_KEEP_OUTSIDE = 8u;   // no culling at the picture's edges
const uint FLAG_KEEP_FAINT = 16u;    // no culling by opacity
const uint FLAG_WHOLE_BOXES = 32u;   // every tile of the bounding box, not only those the ellipse touches
const uint FLAG_NO_EARLY_END = 64u;  // tiles are blended to the end, opaque or not

// What never changes in a run comes first: where a kernel branches on a push constant, lavapipe (Mesa 22.3) takes the
// words of this block at the same offset for constants too, and compiles and keeps one more kernel for each new value
// of theirs. With the camera there, that was a kernel and 0.2 MiB per step.
layout(std140, set = 0, binding = 0) uniform Frame {
    vec4 adam;             // beta1, beta2, epsilon, scale of moments in 16 bits
    vec4 view_row[3];      // world → camera, rotation rows and translation
    vec4 lens;             // fx, fy, cx, cy
    vec4 camera;           // centre in the world; nearest depth
    vec4 clamp_ratio;      // least and greatest x/z, then y/z, of the Jacobian
    uvec4 size;            // picture, pixels; picture, tiles
    uvec4 window;          // rendered tiles: first column, first row, columns, rows
    uvec4 region;          // the same in pixels, cut at the picture's edge
    uvec4 counts;          // Gaussians; active SH degree; flags; resolution divisor
    vec4 background;       // rgb; share of Gaussians dropped (DropGaussian)
    vec4 exposure_gain;    // rgb; least confidence of the depth prior
    vec4 exposure_offset;  // rgb; weight of the depth loss
    vec4 rates;            // mean, log scale, rotation, opacity
    vec4 rates_more;       // SH degree 0, SH above, noise on means (world units), its limit
    vec4 bias;             // 1/(1-beta1^t), 1/(1-beta2^t), -, -
    uvec4 step;            // t, seed, first loss partial (vec4), -
    vec4 loss;             // weight of L1 and of SSIM over (3 * pixels); depth prior's scale and offset
    uvec4 source;          // view's full width and height, u32 offset of its depth prior, -
    vec4 deferred[512];    // k steps unseen: sum of mean steps, of unit steps, beta1^k, beta2^k
} frame;

layout(push_constant) uniform Push {
    uint first;            // first tile of the band
    uint last;             // one past its last tile
    uint mode;
    uint pass;
} push;

// PCG hash (Jarzynski & Olano 2020): same numbers on every device.
uint pcg(uint v) {
    uint s = v * 747796405u + 2891336453u;
    uint w = ((s >> ((s >> 28u) + 4u)) ^ s) * 277803737u;
    return (w >> 22u) ^ w;
}

// Uniform in [0, 1), a function of the seed, the step, a row and a channel only.
float uniform_hash(uint row, uint channel) {
    uint h = pcg(row + pcg(frame.step.x + pcg(frame.step.y + channel * 0x9E3779B9u)));
    return float(h >> 8) * (1.0 / 16777216.0);
}
