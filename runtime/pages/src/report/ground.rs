//! What the map of the page shows beside regions: pictures with their footprints, squares of ground and how well they are
//! covered, and the orthophoto so far. Bounded: [`MAX_SHOTS`] pictures and `MAX_CELLS` squares of each aircraft, and
//! [`MAX_SHOTS_OF_ALL`] pictures of all.

use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::DVec3;
use models::camera::View;
use models::formats::read_bounded;
use serde::{Serialize, Serializer};
use survey::coverage::{CoverageMap, State};
use survey::ortho::crs::Crs;
use survey::ortho::files::preview_step;

/// Pictures shown of one aircraft: `keyframes.max` is at most this.
pub const MAX_SHOTS: usize = 4096;
/// Pictures shown of all aircraft: what a browser draws without making anybody wait.
pub const MAX_SHOTS_OF_ALL: usize = 32_768;
/// A ray that comes down less steeply than this (its sine) meets the ground too far away to be drawn.
const LEAST_DESCENT: f64 = 0.17;
/// Bounds on the two files of a map that are read.
const GEOREF_BYTES: u64 = 1 << 16;
const PREVIEW_BYTES: u64 = 8 << 20;

/// The ground.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Ground {
    /// Pictures.
    pub shots: Vec<Shot>,
    /// Squares of ground, by aircraft.
    pub squares: Vec<Squares>,
    /// The orthophoto.
    pub ortho: Option<Ortho>,
    /// Grows whenever squares or pictures were taken anew.
    #[serde(skip)]
    surveys: u64,
    /// Pictures of each aircraft.
    #[serde(skip)]
    shown: Vec<usize>,
}

/// One picture. Metres east and north, to the decimetre.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Shot {
    /// Whose: number of the aircraft.
    pub of: usize,
    at: [f32; 2],
    foot: Option<[[f32; 2]; 4]>,
}

fn decimetres(p: DVec3) -> [f32; 2] {
    [p.x, p.y].map(|v| ((v * 10.0).round() / 10.0) as f32)
}

impl Shot {
    /// The picture of `view` over ground at height `ground_m`.
    pub fn of(of: usize, view: &View, ground_m: f64) -> Self {
        let (lens, center) = (view.intrinsics, view.pose.center);
        let (w, h) = (f64::from(lens.width), f64::from(lens.height));
        let [fx, fy, cx, cy] = [lens.fx, lens.fy, lens.cx, lens.cy].map(f64::from);
        let meet = |u: f64, v: f64| {
            let ray = DVec3::new((u - cx) / fx, (v - cy) / fy, 1.0);
            let down = (view.pose.rotation * ray).normalize_or_zero();
            let met = center + down * ((ground_m - center.z) / down.z);
            (down.z < -LEAST_DESCENT && center.z > ground_m && met.is_finite()).then(|| decimetres(met))
        };
        let corners = || Some([meet(0.0, 0.0)?, meet(w, 0.0)?, meet(w, h)?, meet(0.0, h)?]);
        Self { of, at: decimetres(center), foot: corners() }
    }
}

/// Squares of ground of one aircraft's region.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Squares {
    of: usize,
    corner: [f64; 2],
    side_m: f64,
    columns: usize,
    #[serde(serialize_with = "as_text")]
    states: Vec<u8>,
}

fn as_text<S: Serializer>(states: &[u8], to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(std::str::from_utf8(states).unwrap_or_default())
}

impl Ground {
    /// Room for as many pictures of one aircraft as a flight may take.
    pub fn with_room(key_frames: usize) -> Self {
        Self { shots: Vec::with_capacity(key_frames.min(MAX_SHOTS)), ..Self::default() }
    }

    /// Shows a picture; beyond the bounds none.
    pub fn add(&mut self, shot: Shot) {
        if self.shown.len() <= shot.of {
            self.shown.resize(shot.of + 1, 0);
        }
        if self.shown[shot.of] < MAX_SHOTS && self.shots.len() < MAX_SHOTS_OF_ALL {
            self.shown[shot.of] += 1;
            self.shots.push(shot);
        }
    }

    /// Shows the squares of an aircraft as they are now; the covered share of its region, 0…1. Memory is taken the first time.
    pub fn survey(&mut self, of: usize, map: &CoverageMap) -> f64 {
        let at = self.squares.iter().position(|s| s.of == of).unwrap_or_else(|| {
            self.squares.push(Squares { of, ..Squares::default() });
            self.squares.len() - 1
        });
        let (grid, squares) = (map.grid(), &mut self.squares[at]);
        (squares.corner, squares.side_m, squares.columns) = (grid.corner.to_array(), grid.side_m, grid.columns);
        let letters =
            (0..grid.rows).flat_map(|row| (0..grid.columns).map(move |column| (column, row))).map(|(c, r)| {
                match map.cell(c, r).map(|cell| cell.state) {
                    None => b'.',
                    Some(State::Unseen) => b'0',
                    Some(State::Thin) => b'1',
                    Some(State::Covered) => b'2',
                }
            });
        squares.states.clear();
        squares.states.extend(letters);
        self.surveys += 1;
        map.covered_share()
    }

    /// Forgets what is shown of an aircraft.
    pub fn forget(&mut self, of: usize) {
        self.shots.retain(|s| s.of != of);
        if let Some(shown) = self.shown.get_mut(of) {
            *shown = 0;
        }
        self.squares.retain(|s| s.of != of);
        self.surveys += 1;
    }

    /// A number that changes with the squares.
    pub fn surveys(&self) -> u64 {
        self.surveys
    }

    /// Whether there is nothing to draw.
    pub fn is_empty(&self) -> bool {
        self.shots.is_empty() && self.squares.is_empty() && self.ortho.is_none()
    }
}

/// A small picture of the map and where it lies.
#[derive(Clone, Debug, Serialize)]
pub struct Ortho {
    /// Address of the picture.
    pub src: String,
    /// Metres east and north of its north-western, north-eastern and south-western corner.
    corners: [[f64; 2]; 3],
}

impl Ortho {
    /// The map in `folder`, drawn in the UTM zone of `origin` or in the scene's own metres, with its picture inside or, given
    /// `address`, to be fetched from there. `None` where there is none that can be placed.
    pub fn read(folder: &Path, origin: Option<Geodetic>, address: Option<String>) -> Option<Self> {
        let georef = read_bounded(&folder.join("map.georef.json"), GEOREF_BYTES).ok()?;
        let georef: serde_json::Value = serde_json::from_slice(&georef).ok()?;
        let number = |name: &str| georef[name].as_f64().filter(|v| v.is_finite());
        let size = [number("columns")?, number("rows")?];
        let crs = match georef["crs"].as_str() {
            None => Crs::local(),
            Some(name) => {
                let crs = Crs::utm(origin?).ok()?;
                crs.epsg().filter(|code| *name == format!("EPSG:{code}"))?;
                crs
            }
        };
        // The small picture's last column and row may reach beyond the map.
        let step = f64::from(preview_step(size.map(|v| v as u32)));
        let [width, height] = size.map(|v| (v / step).ceil() * step * number("gsd_m").unwrap_or(0.0));
        let (west, north) = (number("west")?, number("north")?);
        let place = |x: f64, y: f64| crs.to_enu(DVec3::new(x, y, 0.0)).ok().map(|p| [p.x, p.y]);
        let corners = [place(west, north)?, place(west + width, north)?, place(west, north - height)?];
        let src = match address {
            Some(address) => address,
            None => super::picture::png_uri(&read_bounded(&folder.join("ortho.png"), PREVIEW_BYTES).ok()?),
        };
        Some(Self { src, corners })
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2};
    use models::camera::{Intrinsics, Pose};
    use survey::coverage::CoverageRegion;

    use super::*;

    fn looking(rotation: DQuat) -> View {
        let intrinsics = Intrinsics { width: 80, height: 60, fx: 40.0, fy: 40.0, cx: 40.0, cy: 30.0 };
        View { intrinsics, pose: Pose { rotation, center: DVec3::new(10.0, 20.0, 45.0) } }
    }

    #[test]
    fn a_picture_straight_down_has_its_footprint_and_one_at_the_horizon_has_none() {
        let down = Shot::of(0, &looking(DQuat::from_rotation_x(std::f64::consts::PI)), 5.0);
        assert_eq!(down.foot, Some([[-30.0, 50.0], [50.0, 50.0], [50.0, -10.0], [-30.0, -10.0]]));
        let level = Shot::of(0, &looking(DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2)), 5.0);
        assert!(level.foot.is_none() && level.at == [10.0, 20.0]);
        let below = Shot::of(0, &looking(DQuat::from_rotation_x(std::f64::consts::PI)), 50.0);
        assert!(below.foot.is_none());
    }

    #[test]
    fn squares_say_what_is_covered_and_pictures_are_bounded() {
        let corners = [[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]].map(DVec2::from).to_vec();
        let region = CoverageRegion::new(corners).expect("an area");
        let mut map = CoverageMap::new(&region, 0.0, Default::default()).expect("a map");
        let mut ground = Ground::default();
        assert_eq!(ground.survey(0, &map), 0.0);
        assert!(ground.squares[0].states.iter().all(|s| *s == b'0'));
        map.add(&looking(DQuat::from_rotation_x(std::f64::consts::PI)));
        ground.survey(0, &map);
        assert!(ground.squares.len() == 1 && ground.squares[0].states.contains(&b'1'));
        let shot = Shot::of(0, &looking(DQuat::IDENTITY), 0.0);
        (0..MAX_SHOTS + 9).for_each(|_| ground.add(shot));
        ground.add(Shot { of: 1, ..shot });
        assert_eq!(ground.shots.len(), MAX_SHOTS + 1);
        (2..40).for_each(|of| (0..MAX_SHOTS).for_each(|_| ground.add(Shot { of, ..shot })));
        assert_eq!(ground.shots.len(), MAX_SHOTS_OF_ALL);
        (2..40).for_each(|of| ground.forget(of));
        ground.forget(0);
        assert!(ground.shots.len() == 1 && ground.squares.is_empty() && !ground.is_empty());
    }
}
