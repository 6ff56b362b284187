// Gradient of the blend, front to back: what lies behind a Gaussian is the finished pixel minus what was blended so
// far, so nothing but the transmittance is carried and every decision of the forward pass is met again.
// With DEPTH, colour and depth are carried apart, so that the shape can be frozen against the depth loss.

layout(std430, set = 0, binding = 1) readonly buffer Starts { uint starts[]; };
TEXELS(vec4, 11, image)
TEXELS(vec4, 12, image_gradient)
// What a slot holds: q and its first moments, total weight; second moments, depth; colour. Each number stored costs llvmpipe
// as much as a dozen operations: none is stored that nobody reads.
struct Slot {
    vec4 line;
#ifdef DEPTH
    vec4 square;
#define STORED_SQUARE(square) square
#else
    vec3 square;
#define STORED_SQUARE(square) square.xyz
#endif
    vec3 colour;
};
layout(std430, set = 0, binding = 2) writeonly buffer Slots { Slot slots[]; };

#ifdef LANE_PER_RUN
#define STORED_BY(run) if (own_run == run)
#else
#define STORED_BY(run)
const bool ROLLED = false;
#endif

#ifdef SHARED
// What each lane has of a slot's three vectors, for the lane that adds up that one: no lane holds more than one sum.
shared vec4 shown[3 * gl_WorkGroupSize.x];

void show(vec4 line, vec4 square, vec4 colour) {
    uint at = 3u * gl_LocalInvocationID.x;
    shown[at] = line;
    shown[at + 1u] = square;
    shown[at + 2u] = colour;
}

// In the order of the runs, as `sum_of_tile`.
vec4 sum_of_shown(int vector) {
    uint at = 3u * first_run() + uint(vector);
    vec4 sum = shown[at];
    if (ROLLED) {
        [[dont_unroll]] for (uint run = 1u; run < uint(LANES); run++) sum += shown[at + 3u * run];
    } else {
        [[unroll]] for (uint run = 1u; run < uint(LANES); run++) sum += shown[at + 3u * run];
    }
    return sum;
}
#endif

const int AT_ONCE = 16;

void main() {
    // Before any branch, as in blend.glsl.
    bool to_the_end = (frame.flags & FLAG_NO_EARLY_END) != 0u;
    float thaw = (frame.flags & FLAG_FREEZE_SHAPE) != 0u ? 0.0 : 1.0;
    uint t = tile_of_lane();
    ENTER(t);
    uint base = starts[push.first], first = starts[t] - base, end = present ? starts[t + 1u] - base : first;
    int own_run = run_of_lane();
    ivec2 origin = tile_origin(t);
    vec2 corner = vec2(origin) + 0.5;
    float T[PIXELS];
    float behind[PIXELS];        // dL/d(pixel) · what is still to come
    vec3 gradient[PIXELS];
#ifdef DEPTH
    float depth_behind[PIXELS], depth_gradient[PIXELS];
#endif
    // Where the run's pixels are, to fetch their gradients from again.
    uint own_first = 0u, own_last = 0u;
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        ivec2 p = origin + pixel_of(own_run, k);
        bool inside = pixel_inside(p);
        uint at = 0u;
        if (inside) at = pixel_index(p);
        T[k] = inside ? 1.0 : -1.0;
        vec4 g = FETCH(image_gradient, int(at)), c = FETCH(image, int(at));
        gradient[k] = g.xyz;
        behind[k] = dot(g.xyz, c.xyz);
        if (k == 0) own_first = at;
        own_last = max(own_last, at);
#ifdef DEPTH
        depth_gradient[k] = g.w;
        depth_behind[k] = g.w * c.w;
#endif
    }
    uint i = first;
    bool live = true;
    Splat held;
    WHILE (i < end && live) {
        uint slot = 0u;
        // `precise`: two runs of a row share a factor, which a compiler would take out of their sum.
        precise vec4 line = vec4(0.0), square = vec4(0.0);
        precise vec3 colour = vec3(0.0);
        IF (i < end && live) {
            Splat splat = next_splat(i, first, end, held);
            vec4 s0 = splat.s0, s1 = splat.s1, s2 = splat.s2;
            slot = splat.slot;
            float bend = exp2(2.0 * s1.x);
            [[unroll]] for (int run = 0; run < OWN_RUNS; run++) {
                ivec2 place = run_origin(own_run + run);
                precise vec2 off = corner - s0.xy + vec2(place);
                float dx0 = off.x, dy = off.y;
                vec4 values = run_of(dx0, dy, s0, s1, bend);
                // Sums over the run of q, of q times x and x² (x from the run's first pixel), of weight, depth and colour.
                vec3 sums = vec3(0.0), run_colour = vec3(0.0);
                float total = 0.0, depth = 0.0;
#ifdef DEPTH
                float shape = 0.0, shape_x = 0.0;
#endif
                [[unroll]] for (int x = 0; x < RUN; x++) {
                    int k = run * RUN + x;
                    float raw = values[x];
                    float alpha = min(raw, ALPHA_MAX);
                    alpha = alpha >= ALPHA_MIN ? alpha : 0.0;
                    float weight = alpha * T[k];
                    float next = T[k] - weight;
                    bool taken = next >= TRANSMITTANCE_MIN;
                    weight = taken ? weight : 0.0;
                    // alpha/(1-alpha), only where alpha itself follows the parameters.
                    bool follows = raw <= ALPHA_MAX;
                    float odds = taken && follows ? alpha / (1.0 - alpha) : 0.0;
                    float own = follows ? weight : 0.0;
                    T[k] = taken ? next : -abs(T[k]);
                    vec4 g;
                    if (ROLLED) {
                        g = FETCH(image_gradient, int(min(own_first + uint(k), own_last)));
                    } else {
                        g.xyz = gradient[k];
#ifdef DEPTH
                        g.w = depth_gradient[k];
#endif
                    }
                    float value = fma(s2.z, g.z, fma(s2.y, g.y, s2.x * g.x));
                    behind[k] = fma(-weight, value, behind[k]);
                    float term = fma(own, value, -(odds * behind[k]));
                    run_colour = fma(vec3(weight), g.xyz, run_colour);
#ifdef DEPTH
                    float z_value = s0.z * g.w;
                    depth_behind[k] = fma(-weight, z_value, depth_behind[k]);
                    float z_term = fma(own, z_value, -(odds * depth_behind[k]));
                    depth = fma(weight, g.w, depth);
                    float shape_term = fma(thaw, z_term, term);
                    term += z_term;
                    shape += shape_term;
                    shape_x = fma(shape_term, float(x), shape_x);
                    sums = vec3(sums.x + term, fma(term, float(x), sums.y), fma(shape_term, float(x * x), sums.z));
#else
                    sums = vec3(sums.x + term, fma(term, float(x), sums.y), fma(term, float(x * x), sums.z));
#endif
                    total += weight;
                }
                // From the run's first pixel to the Gaussian's centre.
                float run_x = fma(dx0, sums.x, sums.y);
#ifndef DEPTH
                float shape = sums.x, shape_x = sums.y;
#endif
                float moved = fma(dx0, shape, shape_x);
                float run_xx = fma(dx0, moved + shape_x, sums.z);
                line += vec4(sums.x, run_x, sums.x * dy, total);
                square += vec4(run_xx, moved * dy, shape * dy * dy, depth);
                colour += run_colour;
            }
#ifdef SHARED
            show(line, square, vec4(colour, 0.0));
#endif
        }
#ifdef SHARED
        barrier();
        IF (i < end && live) {
            vec4 sum = sum_of_shown(min(own_run, 2));
            STORED_BY(0) slots[slot].line = sum;
            STORED_BY(1) slots[slot].square = STORED_SQUARE(sum);
            STORED_BY(2) slots[slot].colour = sum.xyz;
            i++;
        }
#else
        // Each sum is stored before the next one is made: fewer registers.
        line = sum_of_tile(line);
        IF (i < end && live) {
            STORED_BY(0) slots[slot].line = line;
        }
        square = sum_of_tile(square);
        IF (i < end && live) {
            STORED_BY(1) slots[slot].square = STORED_SQUARE(square);
        }
        colour = sum_of_tile(vec4(colour, 0.0)).xyz;
        IF (i < end && live) {
            STORED_BY(2) slots[slot].colour = colour;
            i++;
        }
#endif
        float most = T[0];
        [[unroll]] for (int k = 1; k < PIXELS; k++) most = max(most, T[k]);
        live = any_of_tile(most > 0.0) || to_the_end;
    }
    // Slots behind an opaque tile: a total of zero says that the other two vectors were not written. Many in a turn,
    // because llvmpipe ends the loops of an invocation after 65,535 turns in all.
    for (; i < end; i += uint(AT_ONCE * LANES)) {
        [[unroll]] for (int j = 0; j < AT_ONCE; j++) {
            uint at = i + uint(j * LANES + own_run);
            if (at < end) slots[FETCH(instances, int(at)).y].line = vec4(0.0);
        }
    }
}
