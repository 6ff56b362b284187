// Gradient of the blend, front to back: what lies behind a Gaussian is the finished pixel minus what was blended so
// far, so nothing but the transmittance is carried and every decision of the forward pass is met again.
// With DEPTH, colour and depth are carried apart, so that the shape can be frozen against the depth loss.

layout(std430, set = 0, binding = 1) readonly buffer Starts { uint starts[]; };
layout(set = 0, binding = 9) uniform samplerBuffer shaded;
layout(set = 0, binding = 10) uniform usamplerBuffer instances;
layout(set = 0, binding = 11) uniform samplerBuffer image;
layout(set = 0, binding = 12) uniform samplerBuffer image_gradient;
layout(std430, set = 0, binding = 2) writeonly buffer Slots { vec4 slots[]; };

void main() {
    uint t = tile_of_lane();
    if (t >= push.last) return;
    uint base = starts[push.first], first = starts[t] - base, end = starts[t + 1u] - base;
    ivec2 origin = tile_origin(t);
    vec2 corner = vec2(origin) + 0.5;
    float T[PIXELS];
    float behind[PIXELS];        // dL/d(pixel) · what is still to come
    vec3 gradient[PIXELS];
#ifdef DEPTH
    float depth_behind[PIXELS], depth_gradient[PIXELS];
    float thaw = (frame.counts.z & FLAG_FREEZE_SHAPE) != 0u ? 0.0 : 1.0;
#endif
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        bool inside = pixel_inside(origin, k);
        uint at = 0u;
        if (inside) at = pixel_index(origin, k);
        T[k] = inside ? 1.0 : -1.0;
        vec4 g = texelFetch(image_gradient, int(at)), c = texelFetch(image, int(at));
        gradient[k] = g.xyz;
        behind[k] = dot(g.xyz, c.xyz);
#ifdef DEPTH
        depth_gradient[k] = g.w;
        depth_behind[k] = g.w * c.w;
#endif
    }
    uint i = first;
    bool live = true;
    while (i < end && live) {
        uvec2 instance = texelFetch(instances, int(i)).xy;
        int r = int(instance.x) * 3;
        vec4 s0 = texelFetch(shaded, r), s1 = texelFetch(shaded, r + 1), s2 = texelFetch(shaded, r + 2);
        vec2 d = corner - s0.xy;
        float most = -1.0, total = 0.0, depth = 0.0;
        vec3 colour = vec3(0.0);
        float q = 0.0, qx = 0.0, qy = 0.0, qxx = 0.0, qxy = 0.0, qyy = 0.0;
        [[unroll]] for (int y = 0; y < TILE_HEIGHT; y++) {
            float dy = d.y + float(y), along = s1.y * dy, rest = fma(s1.z * dy, dy, s0.w);
            float row = 0.0, row_x = 0.0, row_xx = 0.0;
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
                colour += weight * gradient[k];
#ifdef DEPTH
                float z_value = s0.z * depth_gradient[k];
                depth_behind[k] -= weight * z_value;
                float z_term = own * z_value - odds * depth_behind[k];
                depth += weight * depth_gradient[k];
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
                total += weight;
                most = max(most, T[k]);
            }
            q += row;
            qx += row_x;
            qy += row * dy;
            qxx += row_xx;
#ifdef DEPTH
            qxy += shape_x * dy;
            qyy += shape * dy * dy;
#else
            qxy += row_x * dy;
            qyy += row * dy * dy;
#endif
        }
        uint slot = instance.y * 3u;
        slots[slot] = vec4(q, qx, qy, total);
        slots[slot + 1u] = vec4(qxx, qxy, qyy, depth);
        slots[slot + 2u] = vec4(colour, 0.0);
        live = most > 0.0 || (frame.counts.z & FLAG_NO_EARLY_END) != 0u;
        i++;
    }
    // Slots behind an opaque tile: a total of zero says that the other two vectors were not written.
    while (i < end) {
        slots[texelFetch(instances, int(i)).y * 3u] = vec4(0.0);
        i++;
    }
}
