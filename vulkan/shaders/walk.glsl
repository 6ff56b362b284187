// A sorting lane's walk over its share of the Gaussians, in rounds: a dispatch takes a bounded number of iterations and
// leaves a cursor for the next. llvmpipe ends every loop of an invocation after 65,535 iterations in all (its
// LP_MAX_TGSI_LOOP_ITERATIONS), silently; the walk is one loop, which ends a row of tiles after its budget at the latest.

const uint WALK_BUDGET = 24000u;

struct Walk {
    uint i, end;   // present Gaussian in depth order, one past the last
    int row;       // row of tiles to go on with; -1 at the start of a Gaussian
    uint left;     // iterations that remain in this round
};

Walk walk_begin(uint lane, uint n) {
    uint share = (n + SORT_LANES - 1u) / SORT_LANES;
    Walk w;
    w.i = min(lane * share, n);
    w.end = min(w.i + share, n);
    w.row = -1;
    w.left = WALK_BUDGET;
    return w;
}

void walk_pay(inout Walk w) {
    w.left -= min(w.left, 1u);
}
