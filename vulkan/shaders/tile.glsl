// Who blends a tile: one lane, all pixels in registers, so that a Gaussian's data is read once per tile and the backward
// pass needs no reduction; or, with LANE_PER_RUN, eight neighbouring lanes of a subgroup, a run of four pixels each, which
// takes an eighth of the registers and has eight times the lanes, for devices that have many lanes and few registers each. With
// SHARED, lanes that cannot read each other's registers (VideoCore 6) do it through shared memory.
// Sums over a tile are taken over each run first and then over the runs, in order, so that both leave the same bits.
// Products are added by fma: llvmpipe fuses nothing by itself.

TEXELS(vec4, 9, shaded)
TEXELS(uvec2, 10, instances)

const int RUNS_ACROSS = TILE_WIDTH / RUN, RUNS = RUNS_ACROSS * TILE_HEIGHT;
#ifdef LANE_PER_RUN
const int LANES = RUNS, OWN_RUNS = 1;
#else
const int LANES = 1, OWN_RUNS = RUNS;
#endif
const int PIXELS = OWN_RUNS * RUN;

// The whole window is blended in blocks of 2 × 4 tiles, 16 pixels square: neighbouring lanes wait for each other, and lists of
// tiles that lie close are alike. Tiles of a band follow each other in rows.
//
// Workgroups alternate between the two halves of the picture's tiles; drivers that give each core one contiguous half of
// the workgroups then share the work evenly. A workgroup holds whole tiles.
uint tile_of_lane() {
    uint groups = gl_NumWorkGroups.x, half_groups = (groups + 1u) / 2u, g = gl_WorkGroupID.x;
    uint group = g < half_groups ? 2u * g : 2u * (g - half_groups) + 1u;
    uint place = (group * gl_WorkGroupSize.x + gl_LocalInvocationID.x) / uint(LANES);
    uvec2 window = frame.window;
    bool whole = push.first == 0u && push.last == window.x * window.y;
    const uint across = uint(BLOCK_WIDTH), down = uint(BLOCK_HEIGHT);
    uint blocks = (window.x + across - 1u) / across, block = place / (across * down), own = place % (across * down);
    uint column = block % blocks * across + own % across, row = block / blocks * down + own / across;
    uint in_block = column < window.x && row < window.y ? row * window.x + column : push.last;
    return whole ? in_block : push.first + place;
}

// A lane beyond the last tile ends at once; where others wait for it, it goes on with an empty list and writes nothing.
#ifdef SHARED
#define ENTER(t) bool present = t < push.last; t = present ? t : push.first
#else
#define ENTER(t) if (t >= push.last) return; const bool present = true
#endif

// First run of the tile that this lane holds.
int run_of_lane() {
    return int(gl_LocalInvocationID.x) % LANES;
}

// First pixel of a run, in the tile.
ivec2 run_origin(int run) {
    return ivec2(run % RUNS_ACROSS * RUN, run / RUNS_ACROSS);
}

// Top left pixel of a tile, in the picture.
ivec2 tile_origin(uint t) {
    return ivec2(frame.region_origin) + ivec2(TILE_WIDTH, TILE_HEIGHT) * ivec2(t % frame.window.x, t / frame.window.x);
}

// Pixel k of a lane's runs, from the tile's top left one.
ivec2 pixel_of(int own_run, int k) {
    return run_origin(own_run + k / RUN) + ivec2(k % RUN, 0);
}

// Whether a pixel of the picture is inside the rendered region, and where it is stored.
bool pixel_inside(ivec2 p) {
    return all(lessThan(p, ivec2(frame.region_origin + frame.region)));
}

uint pixel_index(ivec2 p) {
    uvec2 at = uvec2(p) - frame.region_origin;
    return at.y * frame.region.x + at.x;
}

// A Gaussian's value at the four pixels of a run from (dx, dy) off its centre, before it is cut: exp2 of a parabola by
// recurrence, two exponentials instead of four. Where it reaches ALPHA_MIN in the run at all, the exponent changes by less
// than 57 over it (no axis is thinner than LOW_PASS): nothing that matters underflows, and the bound on the ratio keeps 0 · inf away.
const float STEEPEST = 64.0;

vec4 run_of(float dx, float dy, vec4 s0, vec4 s1, float bend) {
    precise float along = s1.y * dy, rest = fma(s1.z * dy, dy, s0.w);
    precise float value = exp2(min(fma(dx, fma(s1.x, dx, along), rest), s0.w));
    // `precise`: of a constant offset a compiler would make other bits than of one that depends on the lane.
    precise float both = dx + (dx + 1.0);
    precise float change = fma(s1.x, both, along);
    precise float ratio = exp2(min(change, STEEPEST));
    precise vec4 run;
    run.x = value;
    run.y = run.x * ratio;
    ratio *= bend;
    run.z = run.y * ratio;
    ratio *= bend;
    run.w = run.z * ratio;
    return run;
}

// An instance: what `shade` left of its Gaussian, and its gradient slot.
struct Splat {
    vec4 s0, s1, s2;
    uint slot;
};

Splat fetch(uint i) {
    uvec2 instance = FETCH(instances, int(i)).xy;
    int r = int(instance.x) * 3;
    return Splat(FETCH(shaded, r), FETCH(shaded, r + 1), FETCH(shaded, r + 2), instance.y);
}

#ifdef LANE_PER_RUN
#define IF(working) if (working)

// Registers are few (`KernelShape::summed` of one): the lanes of a tile are summed in a loop, and a pixel's gradient is fetched again
// for each Gaussian instead of being held.
layout(constant_id = 8) const bool ROLLED = false;

#ifdef SHARED
// The lanes of a workgroup turn together, whether their tiles have ended or not: each meets every barrier.
#define WHILE(working) while (any_of_group(working))

// Of each tile whether one of its lanes says so; of the workgroup, the last one.
shared uint said[gl_WorkGroupSize.x / uint(LANES) + 1u];

uint first_run() {
    return gl_LocalInvocationID.x & ~uint(LANES - 1);
}

// Whether any of the lanes that ask at `place` says so.
bool any_of(bool own, uint place) {
    barrier();
    said[place] = 0u;
    barrier();
    if (own) atomicOr(said[place], 1u);
    barrier();
    return said[place] != 0u;
}

bool any_of_group(bool own) {
    return any_of(own, gl_WorkGroupSize.x / uint(LANES));
}

bool any_of_tile(bool own) {
    return any_of(own, gl_LocalInvocationID.x / uint(LANES));
}
#else
// The lanes of a subgroup turn together, whether their tiles have ended or not: a shuffle reads lanes that are there.
#define WHILE(working) while (subgroupAny(working))

uint first_run() {
    return gl_SubgroupInvocationID & ~uint(LANES - 1);
}

// Whether any lane of the tile says so.
bool any_of_tile(bool own) {
    uint first = first_run();
    return ((subgroupBallot(own)[first >> 5] >> (first & 31u)) & ((1u << LANES) - 1u)) != 0u;
}

// In the order of the runs, so that the sum has the bits of one lane's.
vec4 sum_of_tile(vec4 own) {
    vec4 sum = subgroupShuffle(own, first_run());
    if (ROLLED) {
        [[dont_unroll]] for (uint run = 1u; run < uint(LANES); run++) sum += subgroupShuffle(own, first_run() + run);
    } else {
        [[unroll]] for (uint run = 1u; run < uint(LANES); run++) sum += subgroupShuffle(own, first_run() + run);
    }
    return sum;
}
#endif

#ifdef SHARED
Splat next_splat(uint i, uint first, uint end, inout Splat held) {
    return fetch(i);
}
#else
layout(constant_id = 7) const bool STAGED = false;

// Instance i of those from `first` to `end`, asked for in turn. Staged, every lane fetches one of the next eight into
// `held` and shows it to the others in its turn: an eighth of the fetches, each of which waits for the one before it.
Splat next_splat(uint i, uint first, uint end, inout Splat held) {
    if (!STAGED) return fetch(i);
    uint turn = (i - first) % uint(LANES);
    if (turn == 0u) held = fetch(min(i + uint(run_of_lane()), end - 1u));
    uint lane = first_run() + turn;
    return Splat(
        subgroupShuffle(held.s0, lane), subgroupShuffle(held.s1, lane), subgroupShuffle(held.s2, lane),
        subgroupShuffle(held.slot, lane));
}
#endif
#else
#define WHILE(working) while (working)
#define IF(working)

bool any_of_tile(bool own) {
    return own;
}

vec4 sum_of_tile(vec4 own) {
    return own;
}

Splat next_splat(uint i, uint first, uint end, inout Splat held) {
    return fetch(i);
}
#endif
