#version 450
// The blend, one lane per tile; see blend.glsl.
#extension GL_GOOGLE_include_directive : require

#include "frame.glsl"
#include "tile.glsl"
#include "blend.glsl"
