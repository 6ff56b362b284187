// Exact Adam for Gaussians that were not seen: k steps with a zero gradient only decay the moments, so their steps
// form a sum that depends on k alone (epsilon is 1e-15 and left out). The host keeps that sum in `frame.deferred`.
void catch_up(inout vec4 p, inout vec4 m, inout vec4 v, vec4 step_sum, vec2 decay) {
    vec4 ratio = mix(m * inversesqrt(max(v, vec4(1.0e-37))), vec4(0.0), lessThanEqual(v, vec4(1.0e-37)));
    p -= step_sum * ratio;
    m *= decay.x;
    v *= decay.y;
}

// Both step counters of a Gaussian in one word: low half geometry, high half SH.
uint state_geometry(uint s) { return s & 0xFFFFu; }
uint state_sh(uint s) { return s >> 16; }

uint steps_behind(uint last, uint now) {
    return min((now - last) & 0xFFFFu, 511u);
}
