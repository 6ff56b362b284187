// SSIM's separable window over strips: a lane reads PART + 10 neighbours at once and keeps the sums of PART pixels in registers.

// Three of a texel's four numbers. Written by its name, the fourth is left alone; a swizzle would be a load and a store of all.
struct Texel {
    vec3 value;
};

const int RADIUS = 5;

// A strip at once or, where a lane has not the registers for that, a part of it after the other (`name_short.spv`).
#ifdef SHORT
const int PART = SHORT_PART;
#define PARTS(first) [[dont_unroll]] for (int first = 0; first < STRIP; first += PART)
#else
const int PART = STRIP;
#define PARTS(first) const int first = 0;
#endif

float tap(int offset) {
    return SSIM_WINDOW[abs(offset)];
}
