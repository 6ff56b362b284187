// Projection of one Gaussian, shared by `project` (forward) and `project_backward`: gsplat's EWA splatting, with the
// determinant as a sum of squares (Cauchy-Binet), which stays positive where a*c - b*b cancels.

#include "camera.glsl"

struct Projection {
    vec3 p;          // camera space
    float divisor;   // z; 1 in an orthographic view
    vec2 ratio;      // x/z, y/z clamped for the Jacobian
    bvec2 clamped;
    mat3 rotation;   // own axes → world
    vec3 scale;      // clamped standard deviations
    bvec3 scale_clamped;
    mat3 axes;       // columns: scaled axes in camera space
    vec3 a;          // projected axes, x (px)
    vec3 b;          // projected axes, y (px)
    vec3 cov;        // xx, xy, yy with the low-pass
    float det;
    vec4 q;          // normalised rotation, w x y z
    float q_length;
};

mat3 rotation_of(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

#ifdef PERSPECTIVE_ONLY
const bool ORTHOGRAPHIC = false;
#else
#define ORTHOGRAPHIC ((frame.flags & FLAG_ORTHOGRAPHIC) != 0u)
#endif

// p.z must be positive. In an orthographic view nothing is divided by depth: J = [[fx, 0, 0], [0, fy, 0]], f in pixels per metre.
Projection project_gaussian(vec3 mean, vec3 log_scale, vec4 rotation) {
    Projection s;
    s.p = point_in_camera(mean);
    s.divisor = ORTHOGRAPHIC ? 1.0 : s.p.z;
    float inverse_z = 1.0 / s.divisor;
    vec2 ratio = ORTHOGRAPHIC ? vec2(0.0) : s.p.xy * inverse_z;
    s.ratio = clamp(ratio, frame.min_ratio, frame.max_ratio);
    s.clamped = notEqual(ratio, s.ratio);
    s.q_length = max(length(rotation), 1.0e-20);
    s.q = rotation / s.q_length;
    s.rotation = rotation_of(s.q);
    float limit = SCALE_LIMIT * (ORTHOGRAPHIC ? float(frame.size.x) / frame.focal.x : s.p.z);
    vec3 scale = exp(min(log_scale, vec3(80.0)));
    s.scale = min(scale, vec3(limit));
    s.scale_clamped = greaterThan(scale, vec3(limit));
    s.axes[0] = to_camera(s.rotation[0]) * s.scale.x;
    s.axes[1] = to_camera(s.rotation[1]) * s.scale.y;
    s.axes[2] = to_camera(s.rotation[2]) * s.scale.z;
    vec2 f = frame.focal * inverse_z;
    vec3 ax = vec3(s.axes[0].x, s.axes[1].x, s.axes[2].x);
    vec3 ay = vec3(s.axes[0].y, s.axes[1].y, s.axes[2].y);
    vec3 az = vec3(s.axes[0].z, s.axes[1].z, s.axes[2].z);
    s.a = f.x * (ax - s.ratio.x * az);
    s.b = f.y * (ay - s.ratio.y * az);
    float aa = dot(s.a, s.a), bb = dot(s.b, s.b);
    vec3 c = cross(s.a, s.b);
    s.cov = vec3(aa + LOW_PASS, dot(s.a, s.b), bb + LOW_PASS);
    s.det = dot(c, c) + LOW_PASS * (aa + bb) + LOW_PASS * LOW_PASS;
    return s;
}
