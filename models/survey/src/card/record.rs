//! One picture's own word: EXIF, maker note and XMP brought to one meaning. See the table in [`super`].

use std::cmp::Ordering;
use std::collections::{HashMap, HashSet};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use exif::Tag;
use geometry::geodesy::Geodetic;
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::exif::Fields;
use super::notes::Notes;
use super::xmp::{Maker, Xmp};
use super::{container, lens, maker_note};
use models::formats::natural;
use models::formats::reconstruction::LensDescription;
use models::formats::telemetry::dji_rotation;
use models::picture::Orientation;

/// Plain GPS, one standard deviation, metres.
pub(super) const GPS_SIGMA_M: f64 = 3.0;
/// RTK, fixed and float solutions, where the picture does not say: horizontal and vertical, metres.
const RTK_FIXED_M: [f64; 2] = [0.03, 0.06];
const RTK_FLOAT_M: [f64; 2] = [0.5, 1.0];
/// A height that is not stated, one standard deviation, metres.
pub const UNKNOWN_HEIGHT_SIGMA_M: f64 = 100.0;
/// Heights that an aircraft can have, metres.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = -1000.0..=20_000.0;
/// What a height of thousandths of a metre below zero becomes in 32 bits without a sign, metres.
const WRAPS_M: f64 = 4_294_967.296;
/// Pictures of fewer pixels a side show nothing that can be matched.
const LEAST_SIDE: u32 = 8;
/// No receiver in an aircraft is better; what claims less does not count its lever arm.
const BEST_M: f64 = 0.01;
/// No receiver that says where it is is worse.
const WORST_M: f64 = 1000.0;
/// A pitch in the `Camera:` namespace below this is measured from the horizon, degrees: no mapping camera looks back.
pub(super) const FROM_HORIZON_DEG: f64 = -45.0;

/// A position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fix {
    /// Where, on the picture's own scale of heights.
    pub position: Geodetic,
    /// Standard deviation, horizontal and vertical, metres.
    pub sigma_m: [f64; 2],
}

/// Where an attitude comes from, which decides what it is worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AttitudeSource {
    /// Angles of the camera itself.
    Gimbal,
    /// Angles of the aircraft, under which a camera looking down is mounted.
    Airframe,
    /// A heading alone.
    Heading,
    /// Which way the aircraft moved.
    Course,
}

/// A standard deviation as far as it can be believed, metres.
pub(super) fn believable(sigma_m: f64) -> f64 {
    sigma_m.clamp(BEST_M, WORST_M)
}

/// An attitude.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attitude {
    /// Camera (OpenCV axes, as the pixels are stored) → east-north-up.
    pub rotation: DQuat,
    /// Where it comes from.
    pub source: AttitudeSource,
}

/// What tells a picture's eye.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Eye {
    /// The band or lens that the picture names: XMP `BandName` or `ImageSource`.
    pub stated: Option<String>,
    /// One value a pixel.
    pub is_grey: bool,
}

/// What one picture says.
#[derive(Clone, Debug)]
pub struct Record {
    /// Unique name.
    pub name: String,
    /// Where it lies.
    pub path: PathBuf,
    /// Which way is up.
    pub orientation: Orientation,
    /// Lens at the stored size.
    pub lens: LensDescription,
    /// Relative standard deviation of the focal length.
    pub focal_sigma: f64,
    /// The camera's clock, nanoseconds, and its resolution.
    pub time_ns: Option<(u64, u64)>,
    /// GPS.
    pub fix: Option<Fix>,
    /// Height above take-off, metres.
    pub relative_alt_m: Option<f64>,
    /// Attitude, where anything but the course tells it.
    pub attitude: Option<Attitude>,
    /// Course over ground, degrees clockwise from north, as the receiver says.
    pub course_deg: Option<f64>,
    /// Which eye of the camera took it.
    pub eye: Eye,
    /// What was found wrong with it and how it was mended.
    pub mended: Vec<String>,
}

/// Reads all heads; what cannot be used, and copies of the same file, are noted and left out.
pub(super) fn read_all(files: Vec<PathBuf>, notes: &mut Notes) -> Vec<Record> {
    let read: Vec<Result<Record, String>> = files.par_iter().map(|path| read(path)).collect();
    let mut read: Vec<(PathBuf, Result<Record, String>)> = files.into_iter().zip(read).collect();
    // Of two copies the one with the shorter name is the camera's own ("DJI_0004 (1).JPG", "Copy of …").
    read.sort_by(|a, b| (a.0.as_os_str().len(), &a.0).cmp(&(b.0.as_os_str().len(), &b.0)));
    let mut seen = HashSet::new();
    let mut records = Vec::with_capacity(read.len());
    for (path, record) in read {
        match record {
            Err(why) => notes.add(format!("{why}; left out"), file_name(&path)),
            Ok(_) if !fingerprint(&path).is_none_or(|f| seen.insert(f)) => {
                notes.add("the same file as another one; left out", file_name(&path));
            }
            Ok(mut record) => {
                record.mended.drain(..).for_each(|what| notes.add(what, record.name.clone()));
                records.push(record);
            }
        }
    }
    records.sort_by(|a, b| natural_paths(&a.path, &b.path));
    unique_names(&mut records);
    records
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Length and content hash of the file's ends: two different exposures never agree in both.
fn fingerprint(path: &Path) -> Option<(u64, [u8; 32])> {
    const END: u64 = 64 << 10;
    let mut file = disk::regular::open(path).ok()?;
    let len = file.metadata().ok()?.len();
    let mut bytes = Vec::new();
    file.by_ref().take(END).read_to_end(&mut bytes).ok()?;
    file.seek(SeekFrom::Start(len.saturating_sub(END))).ok()?;
    file.take(END).read_to_end(&mut bytes).ok()?;
    Some((len, *blake3::hash(&bytes).as_bytes()))
}

/// Cards number from 0001 in every folder: names that repeat get their folder's.
fn unique_names(records: &mut [Record]) {
    let mut count: HashMap<String, usize> = HashMap::new();
    records.iter().for_each(|r| *count.entry(r.name.clone()).or_default() += 1);
    for r in records.iter_mut().filter(|r| count[&r.name] > 1) {
        let folder = r.path.parent().map(file_name).unwrap_or_default();
        r.name = format!("{folder}/{}", r.name);
    }
    count.clear();
    for r in records.iter_mut() {
        let n = count.entry(r.name.clone()).or_default();
        *n += 1;
        if *n > 1 {
            r.name = r.path.to_string_lossy().into_owned();
        }
    }
}

/// By time where all have one, else by name: cameras number in order.
pub(super) fn in_order(records: &mut [Record]) {
    match records.iter().all(|r| r.time_ns.is_some()) {
        true => records.sort_by(|a, b| (a.time_ns, &a.name).cmp(&(b.time_ns, &b.name))),
        false => records.sort_by(|a, b| natural_paths(&a.path, &b.path)),
    }
}

fn natural_paths(a: &Path, b: &Path) -> Ordering {
    natural(&a.to_string_lossy(), &b.to_string_lossy())
}

fn read(path: &Path) -> Result<Record, String> {
    let head = container::read(path)?;
    let fields = head.exif.as_ref().map(Fields);
    let exif = fields.as_ref();
    let xmp = head.xmp.as_deref().map(Xmp::parse).unwrap_or_default();
    let projection = xmp.text(Maker::Panorama, "ProjectionType").unwrap_or_default();
    if ["equirectangular", "cylindrical"].iter().any(|p| projection.eq_ignore_ascii_case(p)) {
        return Err(format!("is a panorama ({} projection), no picture through a lens", projection.to_lowercase()));
    }
    if head.size.0.min(head.size.1) < LEAST_SIDE {
        return Err(format!("is smaller than {LEAST_SIDE} pixels"));
    }
    let (lens, focal_sigma) = lens::guess(head.size, exif, &xmp);
    let mut mended = Vec::new();
    Ok(Record {
        name: file_name(path),
        path: path.to_owned(),
        orientation: exif.map(Fields::orientation).unwrap_or_default(),
        lens,
        focal_sigma,
        time_ns: exif.and_then(Fields::time_ns),
        fix: fix(exif, &xmp, &mut mended),
        relative_alt_m: [Maker::Dji, Maker::Parrot, Maker::Skydio]
            .iter()
            .find_map(|m| xmp.number(*m, "RelativeAltitude")),
        attitude: attitude(exif, &xmp),
        course_deg: exif.and_then(Fields::track_deg),
        eye: Eye {
            stated: [(Maker::Pix4d, "BandName"), (Maker::Dji, "BandName"), (Maker::Dji, "ImageSource")]
                .iter()
                .find_map(|(maker, name)| xmp.text(*maker, name).filter(|v| !v.is_empty()))
                .map(str::to_owned),
            is_grey: head.is_grey,
        },
        mended,
    })
}

fn fix(exif: Option<&Fields>, xmp: &Xmp, mended: &mut Vec<String>) -> Option<Fix> {
    let own = |maker, lat: &[&str], lon: &[&str]| {
        let first = |names: &[&str]| names.iter().find_map(|n| xmp.number(maker, n));
        let place = [first(lat)?, first(lon)?];
        let valid = Geodetic { lat_deg: place[0], lon_deg: place[1], alt_m: 0.0 }.is_valid() && place != [0.0, 0.0];
        (valid && xmp.number(maker, "AbsoluteAltitude").is_some()).then_some(place)
    };
    // XMP has more digits than EXIF's rationals in some firmware; `GpsLongtitude` is DJI's own spelling.
    let by_xmp = own(Maker::Dji, &["GpsLatitude", "Latitude"], &["GpsLongitude", "GpsLongtitude", "Longitude"])
        .or_else(|| own(Maker::Skydio, &["Latitude"], &["Longitude"]));
    let [lat_deg, lon_deg] = by_xmp.or_else(|| exif.and_then(Fields::place))?;
    let heights = [
        ("EXIF", exif.and_then(Fields::altitude)),
        ("XMP", [Maker::Dji, Maker::Skydio].iter().find_map(|m| xmp.number(*m, "AbsoluteAltitude"))),
    ];
    let [first, second] = if by_xmp.is_some() { [heights[1], heights[0]] } else { heights };
    let alt_m = height(first, second, mended);
    let position = Geodetic { lat_deg, lon_deg, alt_m: alt_m.unwrap_or_default() };
    let dji = |name| xmp.number(Maker::Dji, name).filter(|v| *v > 0.0);
    let pix4d = |name| xmp.number(Maker::Pix4d, name).filter(|v| *v > 0.0);
    let by_flag = match xmp.number(Maker::Dji, "RtkFlag").map(|f| f as i64) {
        Some(50) => Some(RTK_FIXED_M),
        Some(34) => Some(RTK_FLOAT_M),
        _ => None,
    };
    let horizontal = dji("RtkStdLat")
        .zip(dji("RtkStdLon"))
        .map(|(a, b)| a.max(b))
        .or(by_flag.map(|f| f[0]))
        .or(pix4d("GPSXYAccuracy"))
        .or(exif.and_then(Fields::horizontal_sigma_m))
        .unwrap_or(GPS_SIGMA_M);
    let vertical =
        dji("RtkStdHgt").or(by_flag.map(|f| f[1])).or(pix4d("GPSZAccuracy")).unwrap_or(horizontal.max(GPS_SIGMA_M));
    let vertical = if alt_m.is_some() { vertical } else { UNKNOWN_HEIGHT_SIGMA_M };
    Some(Fix { position, sigma_m: [horizontal, vertical].map(believable) })
}

/// The height that the first source states, unless it cannot be or is a zero beside one that the second states.
fn height(first: (&str, Option<f64>), second: (&str, Option<f64>), mended: &mut Vec<String>) -> Option<f64> {
    let mut believed = |(whose, stated): (&str, Option<f64>)| {
        let stated = stated?;
        let unwrapped = stated - WRAPS_M;
        if !HEIGHTS_M.contains(&stated) && HEIGHTS_M.contains(&unwrapped) {
            mended.push(format!("its {whose} altitude is a negative one in bits without a sign; taken as that"));
            return Some(unwrapped);
        }
        if !HEIGHTS_M.contains(&stated) {
            mended.push(format!("its {whose} altitude is one that no aircraft has; not used"));
            return None;
        }
        Some(stated)
    };
    let [a, b] = [believed(first), believed(second)];
    match (a, b) {
        (Some(0.0), Some(other)) if other != 0.0 => {
            mended.push(format!("its {} altitude is 0 beside another in {}; the latter is taken", first.0, second.0));
            Some(other)
        }
        (None, None) => {
            mended.push("states a position without an altitude; believed within 100 m".to_owned());
            None
        }
        _ => a.or(b),
    }
}

fn attitude(exif: Option<&Fields>, xmp: &Xmp) -> Option<Attitude> {
    let three = |maker, names| xmp.three(maker, names).filter(|v| v.iter().all(|a| a.abs() <= 360.0));
    let from_horizon =
        |[y, p, r]: [f64; 3]| Attitude { rotation: dji_rotation(y, p, r), source: AttitudeSource::Gimbal };
    let airframe =
        |[y, p, r]: [f64; 3]| Attitude { rotation: nadir_rotation(y, p, r), source: AttitudeSource::Airframe };
    // All zero is what firmware writes when it has no gimbal (and a level camera looking north never maps anything).
    let known = |v: &[f64; 3]| *v != [0.0; 3];
    let gimbal = three(Maker::Dji, ["GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"])
        .or_else(|| three(Maker::Parrot, ["CameraYawDegree", "CameraPitchDegree", "CameraRollDegree"]))
        .or_else(|| {
            three(Maker::Skydio, ["CameraOrientationNEDYaw", "CameraOrientationNEDPitch", "CameraOrientationNEDRoll"])
        })
        .or_else(|| exif.and_then(Fields::maker_note).and_then(maker_note::dji_camera_angles))
        .filter(known)
        .map(from_horizon);
    let pix4d = || {
        let [y, p, r] = three(Maker::Pix4d, ["Yaw", "Pitch", "Roll"])?;
        if p < FROM_HORIZON_DEG {
            return Some(from_horizon([y, p, r]));
        }
        let sensefly = exif.and_then(|e| e.text(Tag::Make)).is_some_and(|m| m.to_lowercase().contains("sensefly"));
        let rotation = nadir_rotation(y, p, if sensefly { -r } else { r });
        Some(Attitude { rotation, source: AttitudeSource::Gimbal })
    };
    let body = || {
        three(Maker::Dji, ["FlightYawDegree", "FlightPitchDegree", "FlightRollDegree"])
            .or_else(|| three(Maker::Parrot, ["DroneYawDegree", "DronePitchDegree", "DroneRollDegree"]))
            .map(airframe)
    };
    let heading = || {
        let yaw = exif?.image_direction_deg()?;
        Some(Attitude { rotation: nadir_rotation(yaw, 0.0, 0.0), source: AttitudeSource::Heading })
    };
    gimbal.or_else(pix4d).or_else(body).or_else(heading)
}

/// Camera → east-north-up of a camera that looks down with the heading at the top of its picture when all angles are
/// zero: yaw clockwise from north, pitch up, roll to the right, degrees, in that order about the body's axes.
pub fn nadir_rotation(yaw_deg: f64, pitch_deg: f64, roll_deg: f64) -> DQuat {
    let [yaw, pitch, roll] = [yaw_deg, pitch_deg, roll_deg].map(f64::to_radians);
    let body_to_ned = DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(pitch) * DQuat::from_rotation_x(roll);
    // Right of the picture is the body's right, its lower edge the body's tail, the optical axis the body's down.
    let camera_to_body = DMat3::from_cols(DVec3::Y, -DVec3::X, DVec3::Z);
    let ned_to_enu = DMat3::from_cols(DVec3::Y, DVec3::X, -DVec3::Z);
    DQuat::from_mat3(&(ned_to_enu * DMat3::from_quat(body_to_ned) * camera_to_body)).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_height_that_cannot_be_is_mended_from_the_other_source_and_said() {
        let of = |exif, xmp| {
            let mut mended = Vec::new();
            (height(("EXIF", exif), ("XMP", xmp), &mut mended), mended.join("; "))
        };
        let (alt, why) = of(Some(4_294_914.296), None);
        assert!(alt.is_some_and(|a| (a + 53.0).abs() < 1e-6) && why.contains("without a sign"), "{alt:?} {why}");
        let (alt, why) = of(Some(0.0), Some(198.3));
        assert!(alt == Some(198.3) && why.contains("is 0 beside"), "{why}");
        let (alt, why) = of(Some(1e9), Some(198.3));
        assert!(alt == Some(198.3) && why.contains("no aircraft"), "{why}");
        let (alt, why) = of(None, None);
        assert!(alt.is_none() && why.contains("without an altitude"), "{why}");
        assert_eq!(of(Some(0.0), None), (Some(0.0), String::new()), "sea level");
        assert_eq!(of(Some(12.0), Some(198.0)), (Some(12.0), String::new()));
    }

    #[test]
    fn angles_from_nadir_and_from_the_horizon_agree_where_both_can_be_said() {
        for yaw in [0.0, 45.0, 200.0] {
            for tilt in [0.0, 15.0, 60.0] {
                let a = nadir_rotation(yaw, tilt, 0.0);
                let b = dji_rotation(yaw, tilt - 90.0, 0.0);
                assert!(a.dot(b).abs() > 1.0 - 1e-12, "{yaw} {tilt}");
            }
        }
        // The right wing down: the camera looks to the left of the flight, which goes north.
        let rolled = nadir_rotation(0.0, 0.0, 20.0) * DVec3::Z;
        assert!(rolled.x < -0.3 && rolled.y.abs() < 1e-12, "{rolled}");
    }
}
