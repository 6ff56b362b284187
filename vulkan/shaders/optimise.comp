#version 450
// Adam on a Gaussian's place, opacity, scales and rotation, row by row, from the gradients that `project_backward` left in camera space;
// `optimise_sh` did its SH. Mode 1 writes the gradient to where the first moment is and changes nothing else (gradient checks).
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "camera.glsl"
#include "deferred.glsl"
#include "adam.glsl"

// Parameters are fetched as texels and written back through buffers; each lane touches only its own Gaussians.
TEXELS(vec4, 9, gradients)
TEXELS(vec4, 10, geometry_texels)
TEXELS(vec4, 11, reduced)
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
        float logit = FETCH(geometry_texels, row).w, opacity = sigmoid(logit);
        vec4 by_camera = FETCH(gradients, at);
        // d/dx of the binary entropy of sigmoid(x) is -x sigmoid'(x); the mean is over those in view.
        float entropy = -frame.entropy_weight / float(n) * logit * opacity * (1.0 - opacity);
        vec3 place = to_world(by_camera.xyz) + FETCH(reduced, at + 2).xyz;
        vec4 gradient = finite(vec4(place, by_camera.w * (1.0 - opacity) + entropy));
        vec4 p = step_row(row, gradient, vec4(vec3(frame.mean_rate), frame.opacity_rate));
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
        // A turn by t moves the quaternion q by (0, t/2) q, and what the turn's gradient gives for q is tangent to the sphere.
        vec4 q = FETCH(geometry_texels, row + 2);
        float q_length = max(length(q), 1.0e-20);
        q /= q_length;
        vec3 t = to_world(FETCH(gradients, at + 2).xyz) * (2.0 / q_length);
        p = step_row(row + 2, finite(vec4(-dot(t, q.yzw), q.x * t + cross(t, q.yzw))), vec4(frame.rotation_rate));
        if (push.mode == 0u) geometry[row + 2] = p;
    }
}
