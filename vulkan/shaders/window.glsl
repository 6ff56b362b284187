// SSIM's separable window over strips: a lane reads STRIP + 10 neighbours once and keeps STRIP sums in registers.

// Three of a texel's four numbers. Written by its name, the fourth is left alone; a swizzle would be a load and a store of all.
struct Texel {
    vec3 value;
};

const int STRIP = 8;
const int RADIUS = 5;

float tap(int offset) {
    return SSIM_WINDOW[abs(offset)];
}
