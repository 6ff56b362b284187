#version 450
// The gradient of the camera's pose, one partial sum per lane, from those of the Gaussians as `project_backward` left them. Only where
// a view's pose is trained; before `optimise`, which moves the Gaussians. Reference: the pose of src/reference/project_backward.rs.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"
#include "camera.glsl"

TEXELS(vec4, 9, gradients)
TEXELS(vec4, 10, geometry_texels)
TEXELS(vec4, 11, reduced)
layout(std430, set = 0, binding = 1) readonly buffer Order { uint order[]; };
layout(std430, set = 0, binding = 2) readonly buffer StatusWords { Status status; };
layout(std430, set = 0, binding = 3) writeonly buffer LaneSums { PoseSums lane_sums[]; };

void main() {
    uint n = status.visible, lane = gl_GlobalInvocationID.x;
    vec3 pose_turn = vec3(0.0), pose_shift = vec3(0.0);
    for (uint r = lane; r < n; r += LOOP_LANES) {
        int at = int(r) * 3;
        vec3 p = point_in_camera(FETCH(geometry_texels, int(order[r]) * 9).xyz);
        vec3 point = FETCH(gradients, at).xyz;
        // p' = exp(turn) p + shift.
        pose_turn += cross(p, point) + FETCH(gradients, at + 2).xyz;
        // The camera sees the world move; with it moves the direction that SH are seen from.
        pose_shift += point + to_camera(FETCH(reduced, at + 2).xyz);
    }
    lane_sums[lane].turn = pose_turn;
    lane_sums[lane].shift = pose_shift;
}
