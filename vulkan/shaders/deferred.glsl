// Lazy Adam updates of Gaussians outside the view: k steps with a zero gradient only decay the moments, so their steps
// form a sum that depends on k alone (epsilon is 1e-15 and left out). The host keeps that sum in `frame.deferred`.
void catch_up(inout vec4 p, inout vec4 m, inout vec4 v, vec4 step_sum, MissedSteps missed) {
    vec4 ratio = mix(m * inversesqrt(max(v, vec4(1.0e-37))), vec4(0.0), lessThanEqual(v, vec4(1.0e-37)));
    p -= step_sum * ratio;
    m *= missed.first_decay;
    v *= missed.second_decay;
}

// A Gaussian's state in one word: the steps its geometry (13 bits) and its SH (13 bits) were last moved in, its own SH
// degree (2 bits), and bit 29, which makes the word an ordinary float: it travels as one, and no device may flush or
// quiet it on the way. src/trainer/state.rs writes it, too.
const uint STATE_STEPS = 0x1FFFu;

uint state_of(uint geometry, uint sh, uint degree) {
    return (geometry & STATE_STEPS) | ((sh & STATE_STEPS) << 13) | (degree << 26) | (1u << 29);
}

uint state_geometry(uint s) { return s & STATE_STEPS; }
uint state_sh(uint s) { return (s >> 13) & STATE_STEPS; }
uint state_degree(uint s) { return (s >> 26) & 3u; }

uint steps_behind(uint last, uint now) {
    return min((now - last) & STATE_STEPS, 511u);
}
