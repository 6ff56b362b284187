// Adam's moments of the SH coefficients: as they are, or in 16 bits each where the plan says so. The 16 bits hold the
// first moment and the square root of the second, both times `frame.moment_scale`, which brings gradients of a mean over pixels
// to the size of a pixel's. The root is rounded by chance: to the nearest, the thousandth by which a step changes a second
// moment would be lost or doubled. src/reference/adam.rs has the reference.

TEXELS(vec4, 12, sh_first_texels)
TEXELS(vec4, 13, sh_second_texels)
layout(std430, set = 0, binding = 5) writeonly buffer ShFirst { vec4 sh_first[]; };
layout(std430, set = 0, binding = 6) writeonly buffer ShSecond { vec4 sh_second[]; };
layout(std430, set = 0, binding = 5) writeonly buffer ShFirstHalf { uvec2 sh_first_half[]; };
layout(std430, set = 0, binding = 6) writeonly buffer ShSecondHalf { uvec2 sh_second_half[]; };

#ifdef STORAGE_READS
TEXELS(uvec2, 12, sh_first_halves)
TEXELS(uvec2, 13, sh_second_halves)

vec4 unpack_half(uvec2 v) {
    return vec4(unpackHalf2x16(v.x), unpackHalf2x16(v.y));
}
#endif

const float HALF_MAX = 65504.0;
const uint DROPPED_BITS = 0x1FFFu; // of f32's mantissa in f16

void fetch_moments(int at, out vec4 first, out vec4 second) {
#ifdef STORAGE_READS
    if (HALF_MOMENTS) {
        first = unpack_half(sh_first_halves[at]);
        second = unpack_half(sh_second_halves[at]);
    } else {
        first = sh_first_texels[at];
        second = sh_second_texels[at];
    }
#else
    first = texelFetch(sh_first_texels, at);
    second = texelFetch(sh_second_texels, at);
#endif
    if (HALF_MOMENTS) {
        first /= frame.moment_scale;
        second /= frame.moment_scale;
        second *= second;
    }
}

uvec2 pack_half(vec4 v) {
    return uvec2(packHalf2x16(v.xy), packHalf2x16(v.zw));
}

// Columns of one Gaussian have different chances, and so have the steps.
uvec4 chances(uint at) {
    uint a = pcg(at + pcg(frame.step + pcg(frame.seed))), b = pcg(a);
    return uvec4(a, a >> 13, b, b >> 13) & DROPPED_BITS;
}

void store_moments(uint at, vec4 first, vec4 second) {
    if (HALF_MOMENTS) {
        vec4 root = min(sqrt(second) * frame.moment_scale, vec4(HALF_MAX));
        root = uintBitsToFloat((floatBitsToUint(root) + chances(at)) & ~DROPPED_BITS);
        root = min(root, vec4(HALF_MAX));
        // Without a second moment a first one would be divided by nothing.
        first = mix(clamp(first * frame.moment_scale, -HALF_MAX, HALF_MAX), vec4(0.0), lessThan(root, vec4(6.0e-8)));
        root = mix(root, vec4(0.0), lessThan(root, vec4(6.0e-8)));
        sh_first_half[at] = pack_half(first);
        sh_second_half[at] = pack_half(root);
    } else {
        sh_first[at] = first;
        sh_second[at] = second;
    }
}
