#version 450
// The blend's gradient for colour and depth; see backward.glsl.
#extension GL_GOOGLE_include_directive : require
#define DEPTH
#include "frame.glsl"
#include "tile.glsl"
#include "backward.glsl"
