#version 450
// The blend's gradient for colour alone; see backward.glsl.
#extension GL_GOOGLE_include_directive : require

#include "frame.glsl"
#include "tile.glsl"
#include "backward.glsl"
