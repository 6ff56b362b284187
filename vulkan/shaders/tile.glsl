// One lane blends one tile, all pixels in registers: a Gaussian's data is read once per tile, and the backward pass
// needs no reduction across lanes, because the lane that sums over the tile's pixels is alone.

const int PIXELS = TILE_WIDTH * TILE_HEIGHT;

// Workgroups alternate between the two halves of the picture's tiles; drivers that give each core one contiguous half of
// the workgroups then share the work evenly.
uint tile_of_lane() {
    uint groups = gl_NumWorkGroups.x, half_groups = (groups + 1u) / 2u, g = gl_WorkGroupID.x;
    uint group = g < half_groups ? 2u * g : 2u * (g - half_groups) + 1u;
    return push.first + group * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
}

// Top left pixel of a tile, in the picture.
ivec2 tile_origin(uint t) {
    return ivec2(frame.region.xy) + ivec2(TILE_WIDTH, TILE_HEIGHT) * ivec2(t % frame.window.z, t / frame.window.z);
}

// Whether pixel k of the tile is inside the rendered region, and where it is stored.
bool pixel_inside(ivec2 origin, int k) {
    ivec2 p = origin + ivec2(k % TILE_WIDTH, k / TILE_WIDTH);
    return all(lessThan(p, ivec2(frame.region.xy + frame.region.zw)));
}

uint pixel_index(ivec2 origin, int k) {
    uvec2 p = uvec2(origin + ivec2(k % TILE_WIDTH, k / TILE_WIDTH)) - frame.region.xy;
    return p.y * frame.region.z + p.x;
}
