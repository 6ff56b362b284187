#version 450
// Per tile: where each sorting lane's instances begin, and how many there are in all. One lane per tile.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

layout(std430, set = 0, binding = 1) buffer Tiles { uint tiles[]; };
layout(std430, set = 0, binding = 2) writeonly buffer Starts { uint starts[]; };

// Lanes whose counts are read before any is written, as in sort_scan.comp.
const uint AHEAD = 8u;

void main() {
    uint t = gl_GlobalInvocationID.x, tile_count = frame.window.x * frame.window.y;
    if (t >= tile_count) return;
    uint sum = 0u;
    uint counts[AHEAD];
    for (uint b = 0u; b < SORT_LANES; b += AHEAD) {
        [[unroll]] for (uint k = 0u; k < AHEAD; k++) counts[k] = tiles[(b + k) * tile_count + t];
        [[unroll]] for (uint k = 0u; k < AHEAD; k++) {
            tiles[(b + k) * tile_count + t] = sum;
            sum += counts[k];
        }
    }
    starts[t] = sum;
}
