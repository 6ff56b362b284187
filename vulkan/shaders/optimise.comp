#version 450
// Adam on a Gaussian's place, opacity, scales and rotation, row by row; `optimise_sh` did its SH. Mode 1 writes the gradient to where the
// first moment is and changes nothing else (gradient checks).
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "deferred.glsl"
#include "adam.glsl"

// Parameters are fetched as texels and written back through buffers; each lane touches only its own Gaussians.
TEXELS(vec4, 9, gradients)
TEXELS(vec4, 10, geometry_texels)
layout(std430, set = 0, binding = 1) readonly buffer Order { uint order[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer Geometry { vec4 geometry[]; };

// Box-Muller from two hashes.
float normal_hash(uint gaussian, uint channel) {
    float u = max(uniform_hash(gaussian, channel), 5.0e-8), w = uniform_hash(gaussian, channel + 1u);
    return sqrt(-2.0 * log(u)) * cos(6.2831853 * w);
}

// One row of a Gaussian's geometry after its step; its moments lie three and six rows on.
vec4 step_row(int at, vec4 gradient, vec4 rate) {
    vec4 p = FETCH(geometry_texels, at);
    if (push.mode == 1u) {
        geometry[at + 3] = gradient;
        return p;
    }
    vec4 m = FETCH(geometry_texels, at + 3), v = FETCH(geometry_texels, at + 6);
    adam(p, m, v, gradient, rate);
    geometry[at + 3] = m;
    geometry[at + 6] = v;
    return p;
}

void main() {
    uint n = status.visible;
    for (uint r = gl_GlobalInvocationID.x; r < n; r += LOOP_LANES) {
        uint g = order[r];
        int row = int(g) * 9, at = int(r) * 3;
        float opacity = sigmoid(FETCH(geometry_texels, row).w);
        vec4 p = step_row(row, FETCH(gradients, at), vec4(vec3(frame.mean_rate), frame.opacity_rate));
        if (push.mode == 0u) {
            // Noise on what is nearly transparent, so that it finds a place where it is of use (MCMC, Brush's form).
            float loose = frame.noise * pow(1.0 - opacity, 150.0);
            if (loose > 0.0) {
                vec3 noise = vec3(normal_hash(g, 0u), normal_hash(g, 2u), normal_hash(g, 4u));
                p.xyz += clamp(noise * loose, vec3(-frame.max_noise), vec3(frame.max_noise));
            }
            geometry[row] = p;
        }
        p = step_row(row + 1, FETCH(gradients, at + 1), vec4(vec3(frame.log_scale_rate), 0.0));
        uint own = OWN_DEGREES ? state_degree(floatBitsToUint(p.w)) : SH_DEGREE;
        p.w = uintBitsToFloat(state_of(frame.step, frame.step, own));
        if (push.mode == 0u) geometry[row + 1] = p;
        p = step_row(row + 2, FETCH(gradients, at + 2), vec4(frame.rotation_rate));
        if (push.mode == 0u) geometry[row + 2] = p;
    }
}
