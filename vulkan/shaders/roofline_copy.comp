#version 450
// What the device can move: every lane copies vec4 after vec4, neighbours side by side. Reads through texels, as the
// pipeline's own kernels do (src/pipelines.rs says why).
layout(local_size_x_id = 0, local_size_y = 1, local_size_z = 1) in;
layout(set = 0, binding = 0) uniform samplerBuffer source;
layout(std430, set = 0, binding = 1) writeonly buffer Into { vec4 into[]; };
layout(push_constant) uniform Push { uint count; uint turns; } push;

void main() {
    uint lanes = gl_NumWorkGroups.x * gl_WorkGroupSize.x;
    for (uint i = gl_GlobalInvocationID.x; i < push.count; i += lanes) into[i] = texelFetch(source, int(i));
}
