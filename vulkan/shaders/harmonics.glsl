// Real spherical harmonics as in 3DGS, and their derivatives by the (unit) direction's components.

const uint COEFFICIENTS = (SH_DEGREE + 1u) * (SH_DEGREE + 1u);
// Columns (vec4) that hold the coefficients up to a degree: a Gaussian's own degree says how many are read and written.
uint columns_up_to(uint degree) {
    return degree == 0u ? 1u : degree == 1u ? 3u : degree == 2u ? 7u : 12u;
}

// The basis functions by four, as their coefficients lie in three columns; 0 beyond `degree`. No array holds all of them: each four is
// used and forgotten, and a driver that looks at indices before it unrolls loops would put an array into memory (V3D).
vec4 harmonics_from_0(vec3 d, uint degree) {
    float one = degree >= 1u ? 1.0 : 0.0;
    return vec4(SH_C0, -SH_C1 * d.y * one, SH_C1 * d.z * one, -SH_C1 * d.x * one);
}

vec4 harmonics_from_4(vec3 d, uint degree) {
    float two = degree >= 2u ? 1.0 : 0.0;
    return vec4(
        SH_C2[0] * d.x * d.y * two,
        SH_C2[1] * d.y * d.z * two,
        SH_C2[2] * (2.0 * (d.z * d.z) - d.x * d.x - d.y * d.y) * two,
        SH_C2[3] * d.x * d.z * two);
}

vec4 harmonics_from_8(vec3 d, uint degree) {
    float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
    float two = degree >= 2u ? 1.0 : 0.0, three = degree >= 3u ? 1.0 : 0.0;
    return vec4(
        SH_C2[4] * (xx - yy) * two,
        SH_C3[0] * d.y * (3.0 * xx - yy) * three,
        SH_C3[1] * d.x * d.y * d.z * three,
        SH_C3[2] * d.y * (4.0 * zz - xx - yy) * three);
}

vec4 harmonics_from_12(vec3 d, uint degree) {
    float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
    float three = degree >= 3u ? 1.0 : 0.0;
    return vec4(
        SH_C3[3] * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * three,
        SH_C3[4] * d.x * (4.0 * zz - xx - yy) * three,
        SH_C3[5] * d.z * (xx - yy) * three,
        SH_C3[6] * d.x * (xx - 3.0 * yy) * three);
}

vec4 harmonics_from(uint first, vec3 d, uint degree) {
    if (first == 0u) return harmonics_from_0(d, degree);
    if (first == 4u) return harmonics_from_4(d, degree);
    if (first == 8u) return harmonics_from_8(d, degree);
    return harmonics_from_12(d, degree);
}

// The gradient by the direction of the sum of four basis functions times `w`.
vec3 gradient_from_0(uint degree, vec4 w) {
    return degree >= 1u ? SH_C1 * vec3(-w.w, -w.y, w.z) : vec3(0.0);
}

vec3 gradient_from_4(vec3 d, uint degree, vec4 w) {
    float x = d.x, y = d.y, z = d.z;
    return degree < 2u ? vec3(0.0) : vec3(
        SH_C2[0] * y * w.x - 2.0 * SH_C2[2] * x * w.z + SH_C2[3] * z * w.w,
        SH_C2[0] * x * w.x + SH_C2[1] * z * w.y - 2.0 * SH_C2[2] * y * w.z,
        SH_C2[1] * y * w.y + 4.0 * SH_C2[2] * z * w.z + SH_C2[3] * x * w.w);
}

vec3 gradient_from_8(vec3 d, uint degree, vec4 w) {
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    vec3 three = vec3(
        6.0 * SH_C3[0] * x * y * w.y + SH_C3[1] * y * z * w.z - 2.0 * SH_C3[2] * x * y * w.w,
        3.0 * SH_C3[0] * (xx - yy) * w.y + SH_C3[1] * x * z * w.z + SH_C3[2] * (4.0 * zz - xx - 3.0 * yy) * w.w,
        SH_C3[1] * x * y * w.z + 8.0 * SH_C3[2] * y * z * w.w);
    vec2 two = 2.0 * SH_C2[4] * w.x * vec2(x, -y);
    return (degree >= 2u ? vec3(two, 0.0) : vec3(0.0)) + (degree >= 3u ? three : vec3(0.0));
}

vec3 gradient_from_12(vec3 d, uint degree, vec4 w) {
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    return degree < 3u ? vec3(0.0) : vec3(
        -6.0 * SH_C3[3] * x * z * w.x + SH_C3[4] * (4.0 * zz - 3.0 * xx - yy) * w.y + 2.0 * SH_C3[5] * x * z * w.z
            + 3.0 * SH_C3[6] * (xx - yy) * w.w,
        -6.0 * SH_C3[3] * y * z * w.x - 2.0 * SH_C3[4] * x * y * w.y - 2.0 * SH_C3[5] * y * z * w.z
            - 6.0 * SH_C3[6] * x * y * w.w,
        3.0 * SH_C3[3] * (2.0 * zz - xx - yy) * w.x + 8.0 * SH_C3[4] * x * z * w.y + SH_C3[5] * (xx - yy) * w.z);
}

vec3 gradient_from(uint first, vec3 d, uint degree, vec4 w) {
    if (first == 0u) return gradient_from_0(degree, w);
    if (first == 4u) return gradient_from_4(d, degree, w);
    if (first == 8u) return gradient_from_8(d, degree, w);
    return gradient_from_12(d, degree, w);
}
