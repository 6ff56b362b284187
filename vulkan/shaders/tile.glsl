// Who blends a tile: one lane, all pixels in registers, so that a Gaussian's data is read once per tile and the backward
// pass needs no reduction; or, with LANE_PER_ROW, four neighbouring lanes of a subgroup, one row each, which takes a
// quarter of the registers and has four times the lanes, for devices that have many lanes and few registers each. Sums over
// a tile are taken over each row first and then over the rows, in order, so that both leave the same bits.

TEXELS(vec4, 9, shaded)
TEXELS(uvec2, 10, instances)

#ifdef LANE_PER_ROW
const int LANES = TILE_HEIGHT, ROWS = 1;
#else
const int LANES = 1, ROWS = TILE_HEIGHT;
#endif
const int PIXELS = ROWS * TILE_WIDTH;

// Workgroups alternate between the two halves of the picture's tiles; drivers that give each core one contiguous half of
// the workgroups then share the work evenly. A workgroup holds whole tiles.
uint tile_of_lane() {
    uint groups = gl_NumWorkGroups.x, half_groups = (groups + 1u) / 2u, g = gl_WorkGroupID.x;
    uint group = g < half_groups ? 2u * g : 2u * (g - half_groups) + 1u;
    return push.first + (group * gl_WorkGroupSize.x + gl_LocalInvocationID.x) / uint(LANES);
}

// First row of the tile that this lane holds.
int row_of_lane() {
    return int(gl_LocalInvocationID.x) % LANES;
}

// Top left pixel of a tile, in the picture.
ivec2 tile_origin(uint t) {
    return ivec2(frame.region_origin) + ivec2(TILE_WIDTH, TILE_HEIGHT) * ivec2(t % frame.window.x, t / frame.window.x);
}

// Whether pixel k of those from `origin` on is inside the rendered region, and where it is stored.
bool pixel_inside(ivec2 origin, int k) {
    ivec2 p = origin + ivec2(k % TILE_WIDTH, k / TILE_WIDTH);
    return all(lessThan(p, ivec2(frame.region_origin + frame.region)));
}

uint pixel_index(ivec2 origin, int k) {
    uvec2 p = uvec2(origin + ivec2(k % TILE_WIDTH, k / TILE_WIDTH)) - frame.region_origin;
    return p.y * frame.region.x + p.x;
}

// An instance: what `shade` left of its Gaussian, and its gradient slot.
struct Splat {
    vec4 s0, s1, s2;
    uint slot;
};

Splat fetch(uint i) {
    uvec2 instance = FETCH(instances, int(i)).xy;
    int r = int(instance.x) * 3;
    return Splat(FETCH(shaded, r), FETCH(shaded, r + 1), FETCH(shaded, r + 2), instance.y * 3u);
}

#ifdef LANE_PER_ROW
// The lanes of a subgroup turn together, whether their tiles have ended or not: a shuffle reads lanes that are there.
#define WHILE(working) while (subgroupAny(working))
#define IF(working) if (working)

uint first_row() {
    return gl_SubgroupInvocationID & ~uint(LANES - 1);
}

float most_of_tile(float own) {
    float most = subgroupShuffle(own, first_row());
    [[unroll]] for (uint row = 1u; row < uint(LANES); row++) most = max(most, subgroupShuffle(own, first_row() + row));
    return most;
}

vec4 sum_of_tile(vec4 own) {
    vec4 sum = subgroupShuffle(own, first_row());
    [[unroll]] for (uint row = 1u; row < uint(LANES); row++) sum += subgroupShuffle(own, first_row() + row);
    return sum;
}

layout(constant_id = 7) const bool STAGED = false;

// Instance i of those from `first` to `end`, asked for in turn. Staged, every lane fetches one of the next four into
// `held` and shows it to the others in its turn: a quarter of the fetches, each of which waits for the one before it.
Splat next_splat(uint i, uint first, uint end, inout Splat held) {
    if (!STAGED) return fetch(i);
    uint turn = (i - first) % uint(LANES);
    if (turn == 0u) held = fetch(min(i + uint(row_of_lane()), end - 1u));
    uint lane = first_row() + turn;
    return Splat(
        subgroupShuffle(held.s0, lane), subgroupShuffle(held.s1, lane), subgroupShuffle(held.s2, lane),
        subgroupShuffle(held.slot, lane));
}
#else
#define WHILE(working) while (working)
#define IF(working)

float most_of_tile(float own) {
    return own;
}

vec4 sum_of_tile(vec4 own) {
    return own;
}

Splat next_splat(uint i, uint first, uint end, inout Splat held) {
    return fetch(i);
}
#endif
