// Which tiles a Gaussian touches: the one test that counting and emitting share. The ellipse is convex, so in each row
// of tiles the touched ones are consecutive. `precise`, so that two kernels cannot round differently and
// count other tiles than they emit.

struct Spans {
    vec2 centre;
    float slope, width, half_height, tip;
    int row, last_row;  // rows of tiles, counted from the window's top
};

Spans spans_of(vec4 centre, vec4 span) {
    Spans s;
    s.centre = centre.xy;
    s.slope = span.x;
    s.width = span.y;
    s.half_height = span.z;
    s.tip = span.w;
    float top = float(frame.region_origin.y) + 0.5;
    // Clamped before the conversion: a float beyond the range of int is undefined.
    precise float first = clamp(floor((s.centre.y - s.half_height - top - float(TILE_HEIGHT - 1)) / float(TILE_HEIGHT)) + 1.0, 0.0, 1.0e6);
    precise float last = clamp(floor((s.centre.y + s.half_height - top) / float(TILE_HEIGHT)), -1.0, 1.0e6);
    s.row = int(first);
    s.last_row = min(int(last), int(frame.window.y) - 1);
    return s;
}

// First and last touched tile of row `row`, as columns of the window; empty when first > last.
ivec2 span_in_row(Spans s, int row) {
    precise float y0 = float(int(frame.region_origin.y) + row * TILE_HEIGHT) + 0.5 - s.centre.y;
    precise float y1 = y0 + float(TILE_HEIGHT - 1);
    y0 = clamp(y0, -s.half_height, s.half_height);
    y1 = clamp(y1, -s.half_height, s.half_height);
    precise float square = s.half_height * s.half_height;
    bool box = (frame.flags & FLAG_WHOLE_BOXES) != 0u;
    precise float dy = box ? s.tip : clamp(s.tip, y0, y1);
    precise float right = s.slope * dy + s.width * sqrt(max(square - dy * dy, 0.0)) + 0.01;
    dy = box ? -s.tip : clamp(-s.tip, y0, y1);
    precise float left = s.slope * dy - s.width * sqrt(max(square - dy * dy, 0.0)) - 0.01;
    precise float x = s.centre.x - float(frame.region_origin.x) - 0.5;
    precise float first = clamp(floor((x + left - float(TILE_WIDTH - 1)) / float(TILE_WIDTH)) + 1.0, 0.0, 1.0e6);
    precise float last = clamp(floor((x + right) / float(TILE_WIDTH)), -1.0, 1.0e6);
    return ivec2(int(first), min(int(last), int(frame.window.x) - 1));
}

// The same, cut to the band of tiles [push.first, push.last).
ivec2 span_in_band(Spans s, int row) {
    ivec2 span = span_in_row(s, row);
    int start = row * int(frame.window.x);
    return ivec2(max(span.x, int(push.first) - start), min(span.y, int(push.last) - 1 - start));
}
