// Generated from src/layout.rs, where each field is described once; DGTR_BLESS=1 remakes it.
// The depth loss does not reach scales and rotations.
const uint FLAG_FREEZE_SHAPE = 1u;
// Parallel rays along the view's axis; focal lengths in pixels per metre. Drawn only, never trained on.
const uint FLAG_ORTHOGRAPHIC = 2u;
// The view has a depth prior.
const uint FLAG_DEPTH = 4u;
// No culling at the picture's edges.
const uint FLAG_KEEP_OUTSIDE = 8u;
// No culling by opacity.
const uint FLAG_KEEP_FAINT = 16u;
// Every tile of the bounding box, not only those the ellipse touches.
const uint FLAG_WHOLE_BOXES = 32u;
// Tiles are blended to the end, opaque or not.
const uint FLAG_NO_EARLY_END = 64u;

struct MissedSteps {
    // Sum of the means' steps, in units of m/√v.
    float mean;
    // Sum of steps at rate one.
    float unit;
    // beta1^k.
    float first_decay;
    // beta2^k.
    float second_decay;
};

struct WalkCursor {
    // In depth order.
    uint gaussian;
    // Row of tiles to go on with; -1 at the start of a Gaussian.
    int row;
    // Next gradient slot.
    uint slot;
    // First gradient slot of the present Gaussian.
    uint first_slot;
};

struct Status {
    // Gaussians in view.
    uint visible;
    // Gaussian-tile instances, 2^32 - 1 when there are more.
    uint instances;
    // Pearson's correlation of rendered depth and prior.
    float correlation;
    // 1 when it says something.
    uint correlates;
    // dL/d(depth) = depth_by_prior * prior + depth_by_rendered * depth + depth_constant.
    float depth_by_prior;
    float depth_by_rendered;
    float depth_constant;
    // Instances of each sorting lane's share.
    uint lane_instances[256];
    // 1 when the lane has counted its share to the end.
    uint lane_counted[256];
    WalkCursor cursors[256];
};

struct DepthMoments {
    float count;
    float mean_d;
    float mean_e;
    // Sums of (D - mean)², (E - mean)² and their product.
    float square_d;
    float square_e;
    float product;
    float unused_0;
    float unused_1;
};

struct PoseSums {
    vec3 turn;
    // Gaussians with a gradient that is not finite.
    uint non_finite;
    vec3 shift;
    float unused_0;
};

struct LossSums {
    // By the logarithm of the gain.
    vec3 gain;
    float l1;
    vec3 offset;
    float ssim;
};

layout(std140, set = 0, binding = 0) uniform Frame {
    // What never changes in a run comes first: where a kernel branches on a push constant, lavapipe (Mesa 22.3) takes
    // the words of this block at the same offset for constants too, and compiles and keeps one more kernel for each
    // new value of theirs. With the camera there, that was a kernel and 0.2 MiB per step (tests/compiles_once.rs).
    float beta1;
    float beta2;
    float epsilon;
    // Scale of moments in 16 bits.
    float moment_scale;
    // World → camera: rows of the rotation, translation in w.
    vec4 view_rows[3];
    // fx, fy, pixels.
    vec2 focal;
    vec2 principal_point;
    // In the world.
    vec3 camera_center;
    // Nearest depth that is drawn.
    float near;
    // Bounds of x/z and y/z in the Jacobian.
    vec2 min_ratio;
    vec2 max_ratio;
    // The picture, pixels.
    uvec2 size;
    // The rendered window, tiles.
    uvec2 window;
    // Its first pixel.
    uvec2 region_origin;
    // Its pixels, cut at the picture's edge.
    uvec2 region;
    uint gaussians;
    // Highest SH degree that is evaluated in this step.
    uint sh_degree;
    // FLAG_…
    uint flags;
    // The picture is reduced by this factor.
    uint divisor;
    vec3 background;
    // Share of Gaussians left out (DropGaussian).
    float drop_share;
    vec3 exposure_gain;
    // Least confidence of the depth prior that counts.
    float min_confidence;
    vec3 exposure_offset;
    // Weight of the depth loss.
    float depth_weight;
    float mean_rate;
    float log_scale_rate;
    float rotation_rate;
    float opacity_rate;
    // SH degree 0.
    float sh_dc_rate;
    // SH above.
    float sh_rest_rate;
    // Noise on means, world units, and its bound.
    float noise;
    float max_noise;
    // decay / (1 - beta1^t).
    float first_bias;
    // 1 / (1 - beta2^t).
    float second_bias;
    // t, from 1.
    uint step;
    uint seed;
    // Weight of L1 over 3 * pixels.
    float l1_weight;
    // Weight of SSIM over 3 * pixels.
    float ssim_weight;
    // The view's full width.
    uint source_width;
    // u32 offset of the view's depth prior; 0: none.
    uint depth_offset;
    // Weight of the mean entropy of the opacities in view.
    float entropy_weight;
    // Weight of the magnitude of each SH coefficient above degree 0.
    float sh_weight;
    uint unused_0;
    uint unused_1;
    // By the number of steps missed.
    MissedSteps deferred[512];
} frame;

layout(push_constant) uniform Push {
    // First tile of the band, or first pixel of a part of a picture.
    uint first;
    // One past its last tile.
    uint last;
    uint mode;
    uint pass;
} push;
