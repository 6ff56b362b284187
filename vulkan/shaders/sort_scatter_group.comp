#version 450
// As sort_scatter.comp, with a workgroup of 256 lanes instead of one lane for each share. It takes 256 keys at a time; a
// key's rank among those with its digit is the number of lower lanes that set their bit in the digit's mask, so that the
// order is the same stable one.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) readonly buffer KeysIn { uint keys_in[]; };
layout(std430, set = 0, binding = 2) readonly buffer RowsIn { uint rows_in[]; };
layout(std430, set = 0, binding = 3) writeonly buffer KeysOut { uint keys_out[]; };
layout(std430, set = 0, binding = 4) writeonly buffer RowsOut { uint rows_out[]; };
layout(std430, set = 0, binding = 5) readonly buffer Histogram { uint histogram[]; };
layout(std430, set = 0, binding = 6) readonly buffer StatusWords { Status status; };

const uint WORDS = 8u; // 256 lanes, one bit each

shared uint masks[256u * WORDS];
shared uint next[256];

void main() {
    uint own = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
    uint n = push.pass == 0u ? frame.gaussians : status.visible;
    uint share = (n + SORT_LANES - 1u) / SORT_LANES, first = own * share, end = min(first + share, n), shift = push.pass * 8u;
    next[lane] = histogram[own * 256u + lane];
    for (uint w = 0u; w < WORDS; w++) masks[lane * WORDS + w] = 0u;
    barrier();
    for (uint from = first; from < end; from += 256u) {
        uint i = from + lane, key = 0xFFFFFFFFu;
        if (i < end) key = keys_in[i];
        uint digit = (key >> shift) & 255u, word = lane / 32u, bit = 1u << (lane % 32u);
        bool present = key != 0xFFFFFFFFu;
        if (present) atomicOr(masks[digit * WORDS + word], bit);
        barrier();
        if (present) {
            uint to = next[digit] + uint(bitCount(masks[digit * WORDS + word] & (bit - 1u)));
            for (uint w = 0u; w < word; w++) to += uint(bitCount(masks[digit * WORDS + w]));
            uint row = i;
            if (push.pass != 0u) row = rows_in[i];
            keys_out[to] = key;
            rows_out[to] = row;
        }
        barrier();
        // Each lane moves one digit on.
        uint taken = 0u;
        for (uint w = 0u; w < WORDS; w++) {
            taken += uint(bitCount(masks[lane * WORDS + w]));
            masks[lane * WORDS + w] = 0u;
        }
        next[lane] += taken;
        barrier();
    }
}
