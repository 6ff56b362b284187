//! What is known of one square of ground: counts and sums of fixed size, whatever number of pictures sees it.

use config::coverage::CoverageSettings;
use glam::DVec2;

use super::State;
use super::frustum::Ray;

/// Directions along which the spread of the rays is kept; the widest pair lies within 22.5° of one of them.
const AXES: [DVec2; 4] = [
    DVec2::X,
    DVec2::new(std::f64::consts::FRAC_1_SQRT_2, std::f64::consts::FRAC_1_SQRT_2),
    DVec2::Y,
    DVec2::new(-std::f64::consts::FRAC_1_SQRT_2, std::f64::consts::FRAC_1_SQRT_2),
];
/// Unit vectors are kept in steps of this.
const STEPS: f64 = 32_000.0;
/// A direction is another one when it widens the spread by this much, radians: what the wind does to a gimbal.
const ANOTHER: f64 = 0.0175;

/// One square. 48 bytes.
#[derive(Clone, Debug)]
pub(super) struct Cell {
    /// Least and greatest component along [`AXES`] of the unit vectors towards the cameras, in [`STEPS`].
    low: [i16; 4],
    high: [i16; 4],
    /// Upper triangle of the normal matrix of the point's position from its rays, 1/m² for a noise of one pixel.
    normal: [f32; 6],
    /// Finest ground sampling distance, metres per pixel.
    gsd_m: f32,
    pictures: u16,
    inside: bool,
}

/// What the map says about a square.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellReport {
    /// Whether it is seen well enough.
    pub state: State,
    /// Pictures that see it.
    pub pictures: u16,
    /// Widest angle at which two of them meet there, degrees: at least this, and 92 % of it or more for pictures from above.
    pub angle_deg: f64,
    /// Finest ground sampling distance, metres per pixel; `None` where nothing sees it.
    pub gsd_m: Option<f64>,
    /// Expected standard deviation of a height there, metres; `None` where the rays do not settle it.
    pub sigma_z_m: Option<f64>,
}

impl Cell {
    pub(super) fn new(inside: bool) -> Self {
        Self { low: [i16::MAX; 4], high: [i16::MIN; 4], normal: [0.0; 6], gsd_m: f32::INFINITY, pictures: 0, inside }
    }

    pub(super) fn forget(&mut self) {
        *self = Self::new(self.inside);
    }

    pub(super) fn is_inside(&self) -> bool {
        self.inside
    }

    pub(super) fn add(&mut self, ray: &Ray) {
        self.pictures = self.pictures.saturating_add(1);
        for (k, step) in along(ray).into_iter().enumerate() {
            (self.low[k], self.high[k]) = (self.low[k].min(step), self.high[k].max(step));
        }
        self.gsd_m = self.gsd_m.min(ray.gsd_m as f32);
        // A ray leaves the point free along itself and holds it across, with the weight of a pixel there.
        let (d, weight) = (ray.up, ray.gsd_m.powi(-2));
        let across = |a: f64, b: f64, unit: f64| ((unit - a * b) * weight) as f32;
        let terms = [
            across(d.x, d.x, 1.0),
            across(d.x, d.y, 0.0),
            across(d.x, d.z, 0.0),
            across(d.y, d.y, 1.0),
            across(d.y, d.z, 0.0),
            across(d.z, d.z, 1.0),
        ];
        self.normal.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
    }

    /// 0 to 2: a picture of those that lack, a direction of those that lack.
    pub(super) fn gain(&self, ray: &Ray, rules: &CoverageSettings) -> u32 {
        let lacks_picture = u32::from(self.pictures) < rules.pictures;
        let lacks_angle = self.angle() < f64::from(rules.angle_deg).to_radians();
        let step = (ANOTHER * STEPS) as i32;
        let another = || {
            let mut steps = along(ray).into_iter().enumerate();
            steps.any(|(k, s)| {
                i32::from(s) < i32::from(self.low[k]) - step || i32::from(s) > i32::from(self.high[k]) + step
            })
        };
        u32::from(lacks_picture) + u32::from(lacks_angle && another())
    }

    pub(super) fn is_covered(&self, rules: &CoverageSettings) -> bool {
        u32::from(self.pictures) >= rules.pictures && self.angle() >= f64::from(rules.angle_deg).to_radians()
    }

    pub(super) fn report(&self, rules: &CoverageSettings) -> CellReport {
        let state = match self.pictures {
            0 => State::Unseen,
            _ if self.is_covered(rules) => State::Covered,
            _ => State::Thin,
        };
        CellReport {
            state,
            pictures: self.pictures,
            angle_deg: self.angle().to_degrees(),
            gsd_m: (self.pictures > 0).then_some(f64::from(self.gsd_m)),
            sigma_z_m: self.sigma_z(f64::from(rules.pixel_sigma)),
        }
    }

    /// Radians. The chord between two unit vectors is no shorter than its part along any axis of the plane, so that the angle
    /// is never overstated.
    fn angle(&self) -> f64 {
        let spread = (0..4).map(|k| f64::from(self.high[k]) - f64::from(self.low[k])).fold(0.0, f64::max) / STEPS;
        2.0 * (0.5 * spread).min(1.0).asin()
    }

    /// Least squares for a point on rays of known origin and direction (Förstner & Wrobel, Photogrammetric Computer Vision,
    /// 2016, section 13.4, intersection): the variance of its height is the element of the inverted normal matrix. For two
    /// pictures straight down it is the normal case, σ_z = GSD · √2 σ_px / (base / height).
    fn sigma_z(&self, pixel_sigma: f64) -> Option<f64> {
        let [xx, xy, xz, yy, yz, zz] = self.normal.map(f64::from);
        let minor = xx * yy - xy * xy;
        let determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
        // Rays of a milliradian between them; below that the sums' own rounding decides.
        let settled = determinant > 1e-6 * minor * zz.max(xx + yy) && minor > 0.0;
        settled.then(|| pixel_sigma * (minor / determinant).sqrt()).filter(|s| s.is_finite())
    }
}

fn along(ray: &Ray) -> [i16; 4] {
    AXES.map(|axis| (ray.up.truncate().dot(axis) * STEPS).round() as i16)
}
