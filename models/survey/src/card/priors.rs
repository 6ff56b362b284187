//! From what the pictures say to priors with covariances, in one east-north-up frame.

use std::path::PathBuf;

use geometry::geodesy::{EnuFrame, Geodetic};
use geometry::median;
use glam::{DQuat, DVec3};

use super::notes::Notes;
use super::record::{Attitude, AttitudeSource, Fix, Record, nadir_rotation};
use super::vote::flights;
use models::camera::{Pose, PosePrior, PoseSigma};
use models::formats::reconstruction::LensDescription;
use models::formats::telemetry::TELEMETRY_SIGMA;
use models::picture::Orientation;

/// One picture of a card.
#[derive(Clone, Debug)]
pub struct CardPicture {
    /// Unique: its file name, with as much of its folder as needed.
    pub name: String,
    /// Where it lies.
    pub path: PathBuf,
    /// Which way the camera's top is.
    pub orientation: Orientation,
    /// Lens at full size, after [`CardPicture::orientation`] has been applied.
    pub lens: LensDescription,
    /// Relative standard deviation of the focal length.
    pub focal_sigma: f64,
    /// Whether anything says how it was turned; else it is taken to look down.
    pub has_attitude: bool,
    /// Pose of the camera whose top is the picture's after [`CardPicture::orientation`].
    pub prior: PosePrior,
}

/// Where nothing tells the ground, pictures are taken from a typical mapping height above it, metres.
const UNKNOWN_HEIGHT_M: f64 = 50.0;
/// Movement between two pictures below which it has no direction, metres.
const MIN_MOVE_M: f64 = 2.0;
/// Directions to and from a picture that differ by more are a turn, degrees.
const TURN_DEG: f64 = 45.0;
/// Standard deviations of a camera that is fixed under an aircraft or only believed to look down, of a compass heading,
/// of a course over ground along a line and in a turn: radians.
const MOUNT: f64 = 10.0 * DEG;
const HEADING: f64 = 10.0 * DEG;
const COURSE: f64 = 30.0 * DEG;
const TURNING: f64 = 90.0 * DEG;
const DEG: f64 = std::f64::consts::PI / 180.0;

/// Middle of the positions, at the height of the ground: of the take-off where heights above it are known.
pub(super) fn origin(records: &[Record]) -> Geodetic {
    let of = |f: &dyn Fn(&Record, Fix) -> Option<f64>| {
        median(&mut records.iter().filter_map(|r| f(r, r.fix?)).collect::<Vec<_>>())
    };
    let alt_m = of(&|r, fix| Some(fix.position.alt_m - r.relative_alt_m?))
        .or_else(|| Some(of(&|_, fix| Some(fix.position.alt_m))? - UNKNOWN_HEIGHT_M));
    Geodetic {
        lat_deg: of(&|_, fix| Some(fix.position.lat_deg)).unwrap_or_default(),
        lon_deg: of(&|_, fix| Some(fix.position.lon_deg)).unwrap_or_default(),
        alt_m: alt_m.unwrap_or_default(),
    }
}

/// One picture per record that has a position.
pub(super) fn of(records: &[Record], frame: &EnuFrame, notes: &mut Notes) -> Vec<CardPicture> {
    let places: Vec<Option<DVec3>> = records.iter().map(|r| r.fix.map(|f| frame.to_enu(f.position))).collect();
    let mut pictures = Vec::with_capacity(records.len());
    for flight in flights(records) {
        for i in flight.clone() {
            let r = &records[i];
            let (Some(center), Some(fix)) = (places[i], r.fix) else { continue };
            let (attitude, yaw_sigma) = match r.attitude {
                Some(a) => (a, if a.source == AttitudeSource::Heading { HEADING } else { MOUNT }),
                None => {
                    let (course, sigma) = match r.course_deg {
                        Some(course) => (course, COURSE),
                        None => course(&places[flight.clone()], i - flight.start),
                    };
                    notes.add(
                        "has no attitude: taken as looking down along the course, settled by the pictures",
                        &r.name,
                    );
                    let rotation = nadir_rotation(course, 0.0, 0.0);
                    (Attitude { rotation, source: AttitudeSource::Course }, sigma)
                }
            };
            let rotation = r.orientation.of_rotation(attitude.rotation);
            let rotation_rad = match attitude.source {
                AttitudeSource::Gimbal => TELEMETRY_SIGMA.rotation_rad,
                _ => about_axes(rotation, MOUNT, yaw_sigma),
            };
            let [horizontal, vertical] = fix.sigma_m.map(|s| s as f32);
            pictures.push(CardPicture {
                name: r.name.clone(),
                path: r.path.clone(),
                orientation: r.orientation,
                lens: r.orientation.of_lens(&r.lens),
                focal_sigma: r.focal_sigma,
                has_attitude: !matches!(attitude.source, AttitudeSource::Course | AttitudeSource::Heading),
                prior: PosePrior {
                    pose: Pose { rotation, center },
                    sigma: PoseSigma { position_m: [horizontal, horizontal, vertical], rotation_rad },
                    time_ns: r.time_ns.map_or(0, |t| t.0),
                },
            });
        }
    }
    pictures
}

/// One picture per record, none of which has a position: all looking down from one place, which may be anywhere.
pub(super) fn without_positions(records: &[Record]) -> Vec<CardPicture> {
    let of = |r: &Record| {
        let rotation = r.attitude.map_or_else(|| nadir_rotation(0.0, 0.0, 0.0), |a| a.rotation);
        let pose =
            Pose { rotation: r.orientation.of_rotation(rotation), center: DVec3::new(0.0, 0.0, UNKNOWN_HEIGHT_M) };
        let unknown = [f32::INFINITY; 3];
        CardPicture {
            name: r.name.clone(),
            path: r.path.clone(),
            orientation: r.orientation,
            lens: r.orientation.of_lens(&r.lens),
            focal_sigma: r.focal_sigma,
            has_attitude: r.attitude.is_some(),
            prior: PosePrior {
                pose,
                sigma: PoseSigma { position_m: unknown, rotation_rad: unknown },
                time_ns: r.time_ns.map_or(0, |t| t.0),
            },
        }
    };
    records.iter().map(of).collect()
}

/// Standard deviations about the camera's axes of a tilt and a heading.
fn about_axes(rotation: DQuat, tilt: f64, heading: f64) -> [f32; 3] {
    let up = rotation.conjugate() * DVec3::Z;
    up.to_array().map(|share| (tilt * tilt * (1.0 - share * share) + heading * heading * share * share).sqrt() as f32)
}

/// Course at picture `i`, degrees clockwise from north, and its standard deviation, from where the pictures before and
/// after were taken.
fn course(places: &[Option<DVec3>], i: usize) -> (f64, f64) {
    let step = |a: usize, b: usize| -> Option<DVec3> {
        let way = (places.get(b).copied().flatten()? - places.get(a).copied().flatten()?).with_z(0.0);
        (way.length() > MIN_MOVE_M).then(|| way.normalize())
    };
    let arriving = (0..i).rev().take(3).find_map(|j| step(j, i));
    let leaving = (i + 1..places.len()).take(3).find_map(|j| step(i, j));
    let degrees = |v: DVec3| v.x.atan2(v.y).to_degrees();
    match (arriving, leaving) {
        (Some(a), Some(l)) if a.dot(l) > TURN_DEG.to_radians().cos() => (degrees(a + l), COURSE),
        // At the end of a line the aircraft still flies as it came.
        (Some(a), Some(_)) => (degrees(a), TURNING),
        (Some(v), None) | (None, Some(v)) => (degrees(v), COURSE),
        (None, None) => (0.0, std::f64::consts::PI),
    }
}
