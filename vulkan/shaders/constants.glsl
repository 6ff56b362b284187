// The same numbers as src/constants.rs, where each one's source is cited; tests/constants.rs compares the files.
const float LOW_PASS = 0.3;
const float ALPHA_MAX = 0.999;
const float ALPHA_MIN = 0.003921569;
const float TRANSMITTANCE_MIN = 1.0e-4;
const float FRUSTUM_MARGIN = 0.3;
const float SCALE_LIMIT = 1.0e4;
const float COLOUR_MAX = 1.0e3;
const float SSIM_C1 = 0.0001;
const float SSIM_C2 = 0.0009;
const float SSIM_WINDOW[6] = float[6](0.26601172, 0.21300553, 0.10936069, 0.036000773, 0.007598758, 0.0010283801);
const float PEARSON_EPSILON = 1.0e-6;
const int TILE_WIDTH = 4;
const int TILE_HEIGHT = 4;
const float SH_C0 = 0.28209479;
const float SH_C1 = 0.48860251;
const float SH_C2[5] = float[5](1.0925484, -1.0925484, 0.31539157, -1.0925484, 0.5462742);
const float SH_C3[7] = float[7](-0.5900436, 2.8906114, -0.4570458, 0.37317634, -0.4570458, 1.4453057, -0.5900436);
