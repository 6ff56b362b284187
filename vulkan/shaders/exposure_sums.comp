#version 450
// The exposure's gradient, one partial sum per strip of a column, from the loss's at every pixel as `loss_gradient` left it: by the
// rendered colour, before gain and offset. Only where a view's exposure is trained. Reference: the exposure of src/reference/loss.rs.
#extension GL_GOOGLE_include_directive : require
#include "frame.glsl"

TEXELS(vec4, 9, image)
TEXELS(vec4, 10, image_gradient)
layout(std430, set = 0, binding = 1) writeonly buffer StripSums { LossSums strip_sums[]; };

void main() {
    uint width = frame.size.x, height = frame.size.y, i = gl_GlobalInvocationID.x;
    if (i >= width * ((height + uint(STRIP) - 1u) / uint(STRIP))) return;
    uint column = i % width, y0 = i / width * uint(STRIP);
    vec3 by_gain = vec3(0.0), by_colour = vec3(0.0);
    for (uint y = y0; y < min(y0 + uint(STRIP), height); y++) {
        int at = int(y * width + column);
        vec3 g = FETCH(image_gradient, at).xyz;
        by_gain += g * FETCH(image, at).xyz; // by the logarithm of the gain
        by_colour += g;
    }
    strip_sums[i].gain = by_gain;
    strip_sums[i].offset = by_colour / frame.exposure_gain;
}
