//! The field that [`super`] hands to a ground station: square regions, flown there and back, of made-up ground that all aircraft see alike.

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec2, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::ModelHeader;

use ground::frame::Motion;

/// Ground that an aircraft sees beyond its region, as a share of the region's side: neighbours share a fifth of it.
pub(super) const BEYOND: f64 = 0.1;
/// What is wrong with an aircraft's GPS at most: metres along each axis, and radians of heading.
const ERROR_M: f64 = 2.0;
const ERROR_RAD: f64 = 0.017;
/// Height of flight as a share of the side of a region.
const HEIGHT: f64 = 0.4;
/// Views along a side of the ground that an aircraft sees.
const VIEWS: usize = 4;
/// Their size, pixels.
const SIZE: [u32; 2] = [320, 240];

/// The field.
#[derive(Clone, Debug)]
pub struct Field {
    /// Aircraft; as nearly a square of regions as there are.
    pub aircraft: usize,
    /// Side of the field, metres.
    pub side_m: f64,
    /// Gaussians of each model.
    pub gaussians: usize,
    /// Host memory of the ground station.
    pub limit_mib: u64,
    /// Seed of the ground's colours and of what is wrong with the GPS.
    pub seed: u64,
}

impl Field {
    pub(super) fn columns(&self) -> usize {
        (self.aircraft as f64).sqrt().ceil() as usize
    }

    /// Side of a region, metres.
    pub(super) fn pitch(&self) -> f64 {
        self.side_m / self.columns() as f64
    }

    /// Gaussians along the side of a model: so many that all models lie on one grid.
    pub(super) fn along(&self) -> usize {
        let of_region = (self.gaussians as f64).sqrt() / (1.0 + 2.0 * BEYOND);
        24 * (of_region / 20.0).floor().max(1.0) as usize
    }

    /// Which aircraft has the region in this column and row: there and back, as a field is flown.
    pub(super) fn aircraft_at(&self, column: usize, row: usize) -> Option<usize> {
        let columns = self.columns();
        let along = if row.is_multiple_of(2) { column } else { columns.checked_sub(column + 1)? };
        Some(row * columns + along).filter(|i| column < columns && *i < self.aircraft)
    }

    /// Column and row of an aircraft's region.
    fn place(&self, i: usize) -> (usize, usize) {
        let (along, row) = (i % self.columns(), i / self.columns());
        (if row.is_multiple_of(2) { along } else { self.columns() - 1 - along }, row)
    }

    pub(super) fn corner(&self, i: usize) -> DVec2 {
        let (column, row) = self.place(i);
        DVec2::new(column as f64, row as f64) * self.pitch()
    }

    /// Beside and above.
    pub(super) fn neighbours(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        (0..self.aircraft).flat_map(move |i| {
            let (column, row) = self.place(i);
            let both = [self.aircraft_at(column + 1, row), self.aircraft_at(column, row + 1)];
            both.into_iter().flatten().map(move |j| (i, j))
        })
    }

    /// A number of −1…1 that depends on the seed and on two others.
    fn noise(&self, a: i64, b: i64) -> f64 {
        let mut x =
            self.seed ^ (a as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (b as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// What is wrong with the place of an aircraft.
    pub(super) fn error(&self, i: usize) -> Motion {
        let wrong = |k: i64| self.noise(-1 - i as i64, k);
        let middle = (self.corner(i) + 0.5 * self.pitch()).extend(0.0);
        let turn = DQuat::from_rotation_z(ERROR_RAD * wrong(3));
        let shift = ERROR_M * DVec3::new(wrong(0), wrong(1), wrong(2));
        Motion::rigid(turn, middle + shift - turn * middle)
    }

    /// The model of one aircraft, where its GPS puts it.
    pub(super) fn model(&self, i: usize) -> (ModelHeader, GaussianCloud) {
        let (low, side) = (self.corner(i) - BEYOND * self.pitch(), (1.0 + 2.0 * BEYOND) * self.pitch());
        let along = self.along();
        let spacing = side / along as f64;
        // They cover each other's gaps, as trained ones do: through a gap nothing is lifted.
        let sigma = (0.6 * spacing as f32).ln();
        let mut cloud = GaussianCloud::with_capacity(1, along * along);
        for row in 0..along {
            for column in 0..along {
                let p = low + (DVec2::new(column as f64, row as f64) + 0.5) * spacing;
                // What is there is the same for all: the ground is patched, every patch two Gaussians wide.
                let patch = (p / (2.0 * spacing)).floor();
                let mut sh = [0.0f32; 12];
                for (k, v) in sh.iter_mut().enumerate() {
                    let of = 16 * patch.y as i64 + k as i64;
                    *v = (self.noise(patch.x as i64, of) * if k < 3 { 1.4 } else { 0.02 }) as f32;
                }
                let z = 1.5 * (0.07 * p.x).sin() * (0.05 * p.y).cos();
                let mean = p.extend(z).as_vec3().to_array();
                cloud.push(mean, [sigma, sigma, sigma - 2.0], [1.0, 0.0, 0.0, 0.0], 4.0, &sh);
            }
        }
        let views = (0..VIEWS * VIEWS).map(|v| {
            let at = DVec2::new((v % VIEWS) as f64, (v / VIEWS) as f64) + 0.5;
            (format!("{}-{v}.jpg", id(i)), nadir(low + at * (side / VIEWS as f64), HEIGHT * self.pitch()))
        });
        let mut header = ModelHeader {
            mission: MISSION.into(),
            aircraft: id(i),
            origin: Some(ORIGIN),
            views: views.collect(),
            steps: 1000,
            finished: true,
            ..Default::default()
        };
        let error = self.error(i);
        error.cloud(&mut cloud);
        error.header(&mut header);
        (header, cloud)
    }

    pub(super) fn mission(&self) -> String {
        let [w, h] = SIZE;
        let mut text = format!(
            "name = {MISSION:?}\norigin = {{ lat_deg = {}, lon_deg = {}, alt_m = {} }}\n\
             camera = {{ width = {w}, height = {h}, fx = {FOCAL:.1}, fy = {FOCAL:.1}, cx = {}.0, cy = {}.0 }}\n\
             upload = {{ folder = \"stick\", poll_s = 0.2 }}\nground = {{ epochs = 0, seed = {} }}\nmap = {{ ground = false }}\n",
            ORIGIN.lat_deg,
            ORIGIN.lon_deg,
            ORIGIN.alt_m,
            w / 2,
            h / 2,
            self.seed
        );
        for i in 0..self.aircraft {
            let (c, p) = (self.corner(i), self.pitch());
            text += &format!(
                "[[aircraft]]\nid = {:?}\nlink = \"udpin:127.0.0.1:14550\"\ncamera = {{ folder = \"pictures\" }}\n\
                 region_enu = [[{x:?}, {y:?}], [{x1:?}, {y:?}], [{x1:?}, {y1:?}], [{x:?}, {y1:?}]]\n",
                id(i),
                x = c.x,
                y = c.y,
                x1 = c.x + p,
                y1 = c.y + p
            );
        }
        text
    }
}

const MISSION: &str = "field";
const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 400.0 };
/// Pixels.
const FOCAL: f32 = 260.0;

pub(super) fn id(i: usize) -> String {
    format!("a{i:04}")
}

fn nadir(at: DVec2, height: f64) -> View {
    let [width, height_px] = SIZE;
    let (cx, cy) = (0.5 * width as f32, 0.5 * height_px as f32);
    let intrinsics = Intrinsics { width, height: height_px, fx: FOCAL, fy: FOCAL, cx, cy };
    View { intrinsics, pose: Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: at.extend(height) } }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use config::mission::Mission;

    use super::*;

    #[test]
    fn a_field_has_its_edges_once_and_its_models_on_one_grid() {
        let field = Field { aircraft: 200, side_m: 2000.0, gaussians: 10_000, limit_mib: 512, seed: 1 };
        // 14 whole rows of 14 or 15 columns and what is left.
        assert_eq!(field.columns(), 15);
        assert_eq!(field.neighbours().count(), 13 * 14 + 4 + 12 * 15 + 5);
        let mission = Mission::parse(&field.mission(), Path::new("")).expect("a mission");
        assert_eq!(mission.aircraft.len(), 200);
        assert!(field.along() * field.along() <= field.gaussians && field.along().is_multiple_of(24));
    }

    #[test]
    fn regions_are_numbered_there_and_back_so_that_each_begins_beside_the_one_before() {
        let field = Field { aircraft: 11, side_m: 400.0, gaussians: 10_000, limit_mib: 512, seed: 1 };
        for i in 1..field.aircraft {
            assert!((field.corner(i).distance(field.corner(i - 1)) - field.pitch()).abs() < 1e-9, "{i}");
        }
        // The third row has three of four, from the west.
        assert_eq!([0, 1, 2, 3].map(|column| field.aircraft_at(column, 2)), [Some(8), Some(9), Some(10), None]);
        assert_eq!([field.aircraft_at(0, 1), field.aircraft_at(4, 1), field.aircraft_at(0, 3)], [Some(7), None, None]);
    }
}
