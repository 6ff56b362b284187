// Adam, and gradients that it can take.

void adam(inout vec4 p, inout vec4 m, inout vec4 v, vec4 g, vec4 rate) {
    m += (g - m) * (1.0 - frame.beta1);
    v += (g * g - v) * (1.0 - frame.beta2);
    p -= rate * (m * frame.first_bias) / (sqrt(v * frame.second_bias) + frame.epsilon);
}

vec4 finite(vec4 g, inout bool all_finite) {
    bvec4 bad = not(lessThan(abs(g), vec4(1.0e18))); // also NaN; larger squares would overflow the second moment
    all_finite = all_finite && !any(bad);
    return mix(g, vec4(0.0), bad);
}

vec4 finite(vec4 g) {
    bool ignored;
    return finite(g, ignored);
}
