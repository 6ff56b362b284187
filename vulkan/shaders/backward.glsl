// Gradient of the blend, front to back: what lies behind a Gaussian is the finished pixel minus what was blended so
// far, so nothing but the transmittance is carried and every decision of the forward pass is met again.
// With DEPTH, colour and depth are carried apart, so that the shape can be frozen against the depth loss.

layout(std430, set = 0, binding = 1) readonly buffer Starts { uint starts[]; };
TEXELS(vec4, 11, image)
TEXELS(vec4, 12, image_gradient)
layout(std430, set = 0, binding = 2) writeonly buffer Slots { vec4 slots[]; };

const int AT_ONCE = 16;

void main() {
    uint t = tile_of_lane();
    if (t >= push.last) return;
    uint base = starts[push.first], first = starts[t] - base, end = starts[t + 1u] - base;
    int own_row = row_of_lane();
    ivec2 corner_pixel = tile_origin(t), origin = corner_pixel + ivec2(0, own_row);
    vec2 corner = vec2(corner_pixel) + 0.5;
    float T[PIXELS];
    float behind[PIXELS];        // dL/d(pixel) · what is still to come
    vec3 gradient[PIXELS];
#ifdef DEPTH
    float depth_behind[PIXELS], depth_gradient[PIXELS];
    float thaw = (frame.flags & FLAG_FREEZE_SHAPE) != 0u ? 0.0 : 1.0;
#endif
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        bool inside = pixel_inside(origin, k);
        uint at = 0u;
        if (inside) at = pixel_index(origin, k);
        T[k] = inside ? 1.0 : -1.0;
        vec4 g = FETCH(image_gradient, int(at)), c = FETCH(image, int(at));
        gradient[k] = g.xyz;
        behind[k] = dot(g.xyz, c.xyz);
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
        float most = -1.0;
        // What a slot holds: q and its first moments, total weight; second moments, depth; colour.
        vec4 line = vec4(0.0), square = vec4(0.0), colour = vec4(0.0);
        IF (i < end && live) {
            Splat splat = next_splat(i, first, end, held);
            vec4 s0 = splat.s0, s1 = splat.s1, s2 = splat.s2;
            slot = splat.slot;
            vec2 d = corner - s0.xy;
            [[unroll]] for (int y = 0; y < ROWS; y++) {
                float dy = d.y + float(own_row + y), along = s1.y * dy, rest = fma(s1.z * dy, dy, s0.w);
                float row = 0.0, row_x = 0.0, row_xx = 0.0, row_total = 0.0, row_depth = 0.0;
                vec3 row_colour = vec3(0.0);
#ifdef DEPTH
                float shape = 0.0, shape_x = 0.0;
#endif
                [[unroll]] for (int x = 0; x < TILE_WIDTH; x++) {
                    int k = y * TILE_WIDTH + x;
                    float dx = d.x + float(x);
                    float raw = exp2(min(fma(dx, fma(s1.x, dx, along), rest), s0.w));
                    float alpha = min(raw, ALPHA_MAX);
                    alpha = alpha >= ALPHA_MIN ? alpha : 0.0;
                    float weight = alpha * T[k];
                    float next = T[k] - weight;
                    bool taken = next >= TRANSMITTANCE_MIN;
                    weight = taken ? weight : 0.0;
                    // alpha/(1-alpha), only where alpha itself follows the parameters.
                    float odds = taken && raw <= ALPHA_MAX ? alpha / (1.0 - alpha) : 0.0;
                    float own = raw <= ALPHA_MAX ? weight : 0.0;
                    T[k] = taken ? next : -abs(T[k]);
                    float value = dot(s2.xyz, gradient[k]);
                    behind[k] -= weight * value;
                    float term = own * value - odds * behind[k];
                    row_colour += weight * gradient[k];
#ifdef DEPTH
                    float z_value = s0.z * depth_gradient[k];
                    depth_behind[k] -= weight * z_value;
                    float z_term = own * z_value - odds * depth_behind[k];
                    row_depth += weight * depth_gradient[k];
                    float shape_term = term + thaw * z_term;
                    term += z_term;
                    shape += shape_term;
                    shape_x += shape_term * dx;
                    row_xx += shape_term * dx * dx;
#else
                    row_xx += term * dx * dx;
#endif
                    row += term;
                    row_x += term * dx;
                    row_total += weight;
                    most = max(most, T[k]);
                }
#ifndef DEPTH
                float shape = row, shape_x = row_x;
#endif
                line += vec4(row, row_x, row * dy, row_total);
                square += vec4(row_xx, shape_x * dy, shape * dy * dy, row_depth);
                colour += vec4(row_colour, 0.0);
            }
        }
        line = sum_of_tile(line);
        square = sum_of_tile(square);
        colour = sum_of_tile(colour);
        IF (i < end && live) {
#ifdef LANE_PER_ROW
            if (own_row < 3) slots[slot + uint(own_row)] = own_row == 0 ? line : own_row == 1 ? square : colour;
#else
            slots[slot] = line;
            slots[slot + 1u] = square;
            slots[slot + 2u] = colour;
#endif
            i++;
        }
        live = most_of_tile(most) > 0.0 || (frame.flags & FLAG_NO_EARLY_END) != 0u;
    }
    // Slots behind an opaque tile: a total of zero says that the other two vectors were not written. Many in a turn,
    // because llvmpipe ends the loops of an invocation after 65,535 turns in all.
    for (; i < end; i += uint(AT_ONCE * LANES)) {
        [[unroll]] for (int j = 0; j < AT_ONCE; j++) {
            uint at = i + uint(j * LANES + own_row);
            if (at < end) slots[FETCH(instances, int(at)).y * 3u] = vec4(0.0);
        }
    }
}
