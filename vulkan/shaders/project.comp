#version 450
// Culls and projects every Gaussian, after the lazy Adam updates that it missed outside the view. One lane per Gaussian.
// Mode 1 does those updates for all of them and projects nothing (before the host reads or moves Gaussians).
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "projection.glsl"
#include "deferred.glsl"

// Parameters are fetched as texels and written back through the buffer; each lane touches only its own Gaussian.
TEXELS(vec4, 9, geometry_texels)
layout(std430, set = 0, binding = 1) writeonly buffer Geometry { vec4 geometry[]; };
layout(std430, set = 0, binding = 2) writeonly buffer Projected { vec4 projected[]; };
layout(std430, set = 0, binding = 3) writeonly buffer Keys { uint keys[]; };

void main() {
    uint g = gl_GlobalInvocationID.x;
    if (g >= frame.gaussians) return;
    int row = int(g) * 9;
    vec4 p0 = FETCH(geometry_texels, row), p1 = FETCH(geometry_texels, row + 1), p2 = FETCH(geometry_texels, row + 2);
    uint state = floatBitsToUint(p1.w);
    uint behind = steps_behind(state_geometry(state), frame.step - 1u);

    float z = dot(frame.view_rows[2].xyz, p0.xyz) + frame.view_rows[2].w;
    // Who is far behind the camera cannot have come in front of it by what little the deferred steps move.
    bool near_view = push.mode == 1u || z > 0.0;
    if (behind > 0u && near_view) {
        MissedSteps missed = frame.deferred[behind];
        vec4 m0 = FETCH(geometry_texels, row + 3), m1 = FETCH(geometry_texels, row + 4), m2 = FETCH(geometry_texels, row + 5);
        vec4 v0 = FETCH(geometry_texels, row + 6), v1 = FETCH(geometry_texels, row + 7), v2 = FETCH(geometry_texels, row + 8);
        catch_up(p0, m0, v0, vec4(vec3(missed.mean), missed.unit * frame.opacity_rate), missed);
        catch_up(p1, m1, v1, vec4(vec3(missed.unit * frame.log_scale_rate), 0.0), missed);
        catch_up(p2, m2, v2, vec4(missed.unit * frame.rotation_rate), missed);
        state = state_of(frame.step - 1u, state_sh(state), state_degree(state));
        p1.w = uintBitsToFloat(state);
        geometry[g * 9 + 0] = p0;
        geometry[g * 9 + 1] = p1;
        geometry[g * 9 + 2] = p2;
        geometry[g * 9 + 3] = m0;
        geometry[g * 9 + 4] = m1;
        geometry[g * 9 + 5] = m2;
        geometry[g * 9 + 6] = v0;
        geometry[g * 9 + 7] = v1;
        geometry[g * 9 + 8] = v2;
    }
    if (push.mode == 1u) return;

    float drop = frame.drop_share;
    float opacity = sigmoid(p0.w) / (1.0 - drop);
    bool dropped = drop > 0.0 && uniform_hash(g, 7u) < drop;
    z = dot(frame.view_rows[2].xyz, p0.xyz) + frame.view_rows[2].w;
    float faintest = (frame.flags & FLAG_KEEP_FAINT) != 0u ? 1.0e-30 : ALPHA_MIN;
    bool visible = z >= frame.near && z < 1.0e30 && opacity >= faintest && !dropped;

    Projection s = project_gaussian(p0.xyz, p1.xyz, p2);
    vec2 centre = s.p.xy / s.divisor * frame.focal + frame.principal_point;
    float inverse_det = 1.0 / s.det;
    vec3 conic = vec3(s.cov.z, -s.cov.y, s.cov.x) * inverse_det;
    // Inside the ellipse d'Kd <= reach the Gaussian's alpha is at least ALPHA_MIN.
    float log2_opacity = log2(opacity);
    float reach = 2.0 * 0.69314718 * (log2_opacity - log2(ALPHA_MIN));
    // A hundredth of a pixel more than exact, so that rounding never drops a pixel that the blend would take.
    vec2 half_size = sqrt(max(reach, 0.0) * s.cov.xz) + 0.01;
    vec2 least = centre - half_size, most = centre + half_size;
    bool inside = all(lessThanEqual(least, vec2(frame.size) - 0.5)) && all(greaterThanEqual(most, vec2(0.5)));
    bool kept = (frame.flags & FLAG_KEEP_OUTSIDE) != 0u && all(lessThan(abs(centre), vec2(1.0e9)));
    visible = visible && (inside || kept);
    // Comparisons with NaN are false: whatever is not a number is not visible.
    keys[g] = visible ? floatBitsToUint(z) : 0xFFFFFFFFu;
    if (visible) {
        const float LOG2E = 1.44269504;
        projected[g * 3 + 0] = vec4(centre, z, log2_opacity);
        projected[g * 3 + 1] = vec4(conic * vec3(-0.5, -1.0, -0.5) * LOG2E, 0.0);
        // Right edge of the ellipse at height dy: slope * dy + width * sqrt(half_size.y^2 - dy^2), widest at dy = tip.
        projected[g * 3 + 2] = vec4(s.cov.y / s.cov.z, sqrt(s.det) / s.cov.z, half_size.y, s.cov.y / s.cov.x * half_size.x);
    }
}
