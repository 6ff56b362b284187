// Real spherical harmonics as in 3DGS, and their derivatives by the (unit) direction's components.

const uint COEFFICIENTS = (SH_DEGREE + 1u) * (SH_DEGREE + 1u);
// Columns (vec4) that hold the coefficients up to each degree: a Gaussian's own degree says how many are read and written.
const uint COLUMNS_UP_TO[4] = uint[4](1u, 3u, 7u, 12u);

void harmonics(vec3 d, uint degree, out float y[16]) {
    float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
    float one = degree >= 1u ? 1.0 : 0.0, two = degree >= 2u ? 1.0 : 0.0, three = degree >= 3u ? 1.0 : 0.0;
    y[0] = SH_C0;
    y[1] = -SH_C1 * d.y * one;
    y[2] = SH_C1 * d.z * one;
    y[3] = -SH_C1 * d.x * one;
    y[4] = SH_C2[0] * d.x * d.y * two;
    y[5] = SH_C2[1] * d.y * d.z * two;
    y[6] = SH_C2[2] * (2.0 * zz - xx - yy) * two;
    y[7] = SH_C2[3] * d.x * d.z * two;
    y[8] = SH_C2[4] * (xx - yy) * two;
    y[9] = SH_C3[0] * d.y * (3.0 * xx - yy) * three;
    y[10] = SH_C3[1] * d.x * d.y * d.z * three;
    y[11] = SH_C3[2] * d.y * (4.0 * zz - xx - yy) * three;
    y[12] = SH_C3[3] * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * three;
    y[13] = SH_C3[4] * d.x * (4.0 * zz - xx - yy) * three;
    y[14] = SH_C3[5] * d.z * (xx - yy) * three;
    y[15] = SH_C3[6] * d.x * (xx - 3.0 * yy) * three;
}

// Sum over coefficients of weight[i] times the gradient of basis function i.
vec3 harmonics_gradient(vec3 d, uint degree, float w[16]) {
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    vec3 g1 = SH_C1 * vec3(-w[3], -w[1], w[2]);
    vec3 g2 = vec3(
        SH_C2[0] * y * w[4] - 2.0 * SH_C2[2] * x * w[6] + SH_C2[3] * z * w[7] + 2.0 * SH_C2[4] * x * w[8],
        SH_C2[0] * x * w[4] + SH_C2[1] * z * w[5] - 2.0 * SH_C2[2] * y * w[6] - 2.0 * SH_C2[4] * y * w[8],
        SH_C2[1] * y * w[5] + 4.0 * SH_C2[2] * z * w[6] + SH_C2[3] * x * w[7]);
    vec3 g3 = vec3(
        6.0 * SH_C3[0] * x * y * w[9] + SH_C3[1] * y * z * w[10] - 2.0 * SH_C3[2] * x * y * w[11]
            - 6.0 * SH_C3[3] * x * z * w[12] + SH_C3[4] * (4.0 * zz - 3.0 * xx - yy) * w[13]
            + 2.0 * SH_C3[5] * x * z * w[14] + 3.0 * SH_C3[6] * (xx - yy) * w[15],
        3.0 * SH_C3[0] * (xx - yy) * w[9] + SH_C3[1] * x * z * w[10] + SH_C3[2] * (4.0 * zz - xx - 3.0 * yy) * w[11]
            - 6.0 * SH_C3[3] * y * z * w[12] - 2.0 * SH_C3[4] * x * y * w[13]
            - 2.0 * SH_C3[5] * y * z * w[14] - 6.0 * SH_C3[6] * x * y * w[15],
        SH_C3[1] * x * y * w[10] + 8.0 * SH_C3[2] * y * z * w[11] + 3.0 * SH_C3[3] * (2.0 * zz - xx - yy) * w[12]
            + 8.0 * SH_C3[4] * x * z * w[13] + SH_C3[5] * (xx - yy) * w[14]);
    vec3 g = vec3(0.0);
    if (degree >= 1u) g += g1;
    if (degree >= 2u) g += g2;
    if (degree >= 3u) g += g3;
    return g;
}
