// Blends colour and depth front to back: C = sum c a T + T_end background, D = sum z a T (paper, depth equation). With
// MEDIAN_DEPTH, D is the depth of the Gaussian that takes the second half of the light: what floats thinly in front of a surface
// does not pull it up.

layout(std430, set = 0, binding = 1) buffer Starts { uint starts[]; };
layout(std430, set = 0, binding = 2) writeonly buffer Image { vec4 image[]; };
layout(std430, set = 0, binding = 3) writeonly buffer Transmittance { float transmittance[]; };

void main() {
    uint t = tile_of_lane();
    if (t >= push.last) return;
    uint base = starts[push.first], first = starts[t] - base, end = starts[t + 1u] - base;
    int own_row = row_of_lane();
    ivec2 corner_pixel = tile_origin(t), origin = corner_pixel + ivec2(0, own_row);
    vec2 corner = vec2(corner_pixel) + 0.5;
    float T[PIXELS];
    vec4 sum[PIXELS];
    // A negative transmittance marks a finished pixel.
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        T[k] = pixel_inside(origin, k) ? 1.0 : -1.0;
        sum[k] = vec4(0.0);
    }
    uint i = first;
    bool live = true;
    Splat held;
    WHILE (i < end && live) {
        float most = -1.0;
        IF (i < end && live) {
            Splat splat = next_splat(i, first, end, held);
            vec4 s0 = splat.s0, s1 = splat.s1, s2 = splat.s2;
            vec4 value = vec4(s2.xyz, s0.z);
            vec2 d = corner - s0.xy;
            [[unroll]] for (int y = 0; y < ROWS; y++) {
                float dy = d.y + float(own_row + y), along = s1.y * dy, rest = fma(s1.z * dy, dy, s0.w);
                [[unroll]] for (int x = 0; x < TILE_WIDTH; x++) {
                    int k = y * TILE_WIDTH + x;
                    float dx = d.x + float(x);
                    float alpha = min(exp2(min(fma(dx, fma(s1.x, dx, along), rest), s0.w)), ALPHA_MAX);
                    alpha = alpha >= ALPHA_MIN ? alpha : 0.0;
                    float weight = alpha * T[k];
                    float next = T[k] - weight;
                    bool taken = next >= TRANSMITTANCE_MIN;
                    weight = taken ? weight : 0.0;
#ifdef MEDIAN_DEPTH
                    sum[k].w = T[k] > 0.5 && next <= 0.5 ? value.w : sum[k].w;
                    sum[k].xyz += weight * value.xyz;
#else
                    sum[k] += weight * value;
#endif
                    T[k] = taken ? next : -abs(T[k]);
                    most = max(most, T[k]);
                }
            }
            i++;
        }
        live = most_of_tile(most) > 0.0 || (frame.flags & FLAG_NO_EARLY_END) != 0u;
    }
    // Counted work: how many Gaussians were blended before the tile was opaque.
    if (own_row == 0) starts[frame.window.x * frame.window.y + 1u + t] = i - first;
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        if (pixel_inside(origin, k)) {
            uint at = pixel_index(origin, k);
            float left = abs(T[k]);
            image[at] = sum[k] + vec4(left * frame.background, 0.0);
            transmittance[at] = left;
        }
    }
}
