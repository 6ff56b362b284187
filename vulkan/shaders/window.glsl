// SSIM's separable window over strips: a lane reads STRIP + 10 neighbours once and keeps STRIP sums in registers.

const int STRIP = 8;
const int RADIUS = 5;

float tap(int offset) {
    return SSIM_WINDOW[abs(offset)];
}
