#version 450
// The blend with the median depth, one lane per tile; see blend.glsl.
#extension GL_GOOGLE_include_directive : require
#define MEDIAN_DEPTH

#include "frame.glsl"
#include "tile.glsl"
#include "blend.glsl"
