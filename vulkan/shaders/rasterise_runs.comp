#version 450
// The blend, a lane per run of a tile; see blend.glsl.
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#define LANE_PER_RUN

#include "frame.glsl"
#include "tile.glsl"
#include "blend.glsl"
