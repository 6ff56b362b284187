// Blends colour and depth front to back: C = sum c a T + T_end background, D = sum z a T (paper, depth equation). With
// MEDIAN_DEPTH, D is the depth of the Gaussian that takes the second half of the light: what floats thinly in front of a surface
// does not pull it up.

layout(std430, set = 0, binding = 1) buffer Starts { uint starts[]; };
layout(std430, set = 0, binding = 2) writeonly buffer Image { vec4 image[]; };
layout(std430, set = 0, binding = 3) writeonly buffer Transmittance { float transmittance[]; };

void main() {
    // Read before any branch: uniforms then cost llvmpipe one load each, behind one a gather.
    bool to_the_end = (frame.flags & FLAG_NO_EARLY_END) != 0u;
    vec3 background = frame.background;
    uint counters = frame.window.x * frame.window.y + 1u;
    uint t = tile_of_lane();
    ENTER(t);
    uint base = starts[push.first], first = starts[t] - base, end = present ? starts[t + 1u] - base : first;
    int own_run = run_of_lane();
    ivec2 origin = tile_origin(t);
    vec2 corner = vec2(origin) + 0.5;
    float T[PIXELS];
    vec4 sum[PIXELS];
    // A negative transmittance marks a finished pixel.
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        T[k] = pixel_inside(origin + pixel_of(own_run, k)) ? 1.0 : -1.0;
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
            float bend = exp2(2.0 * s1.x);
            [[unroll]] for (int run = 0; run < OWN_RUNS; run++) {
                ivec2 place = run_origin(own_run + run);
                precise vec2 off = corner - s0.xy + vec2(place);
                vec4 raw = run_of(off.x, off.y, s0, s1, bend);
                [[unroll]] for (int x = 0; x < RUN; x++) {
                    int k = run * RUN + x;
                    float alpha = min(raw[x], ALPHA_MAX);
                    alpha = alpha >= ALPHA_MIN ? alpha : 0.0;
                    float weight = alpha * T[k];
                    float next = T[k] - weight;
                    bool taken = next >= TRANSMITTANCE_MIN;
                    weight = taken ? weight : 0.0;
#ifdef MEDIAN_DEPTH
                    sum[k].w = T[k] > 0.5 && next <= 0.5 ? value.w : sum[k].w;
                    sum[k].xyz = fma(vec3(weight), value.xyz, sum[k].xyz);
#else
                    sum[k] = fma(vec4(weight), value, sum[k]);
#endif
                    T[k] = taken ? next : -abs(T[k]);
                    most = max(most, T[k]);
                }
            }
            i++;
        }
        live = any_of_tile(most > 0.0) || to_the_end;
    }
    // Counted work: how many Gaussians were blended before the tile was opaque.
    if (own_run == 0 && present) starts[counters + t] = i - first;
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        ivec2 p = origin + pixel_of(own_run, k);
        if (pixel_inside(p) && present) {
            uint at = pixel_index(p);
            float left = abs(T[k]);
            image[at] = sum[k] + vec4(left * background, 0.0);
            transmittance[at] = left;
        }
    }
}
