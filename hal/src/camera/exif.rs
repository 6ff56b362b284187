//! What a picture says about itself: the camera's clock, and a pose (EXIF GPS position, DJI's XMP gimbal angles) for use
//! when the autopilot's is missing.

use std::io::{BufReader, Read};
use std::path::Path;

use exif::{DateTime, Exif, In, Reader, Tag, Value};
use geometry::geodesy::Geodetic;
use glam::DQuat;

use crate::frames::{attitude_to_enu, euler_to_ned};

/// XMP stands in the first segments of the file.
const XMP_WITHIN: u64 = 256 << 10;

/// The pose in a picture's own data.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExifPose {
    /// Where; the altitude is on whatever scale the camera uses.
    pub position: Geodetic,
    /// Mount (FLU, optical axis forward) → ENU, when gimbal angles are given.
    pub mount: Option<DQuat>,
}

fn read(path: &Path) -> Option<Exif> {
    let mut file = BufReader::new(disk::regular::open(path).ok()?);
    Reader::new().read_from_container(&mut file).ok()
}

/// The camera's clock at the exposure, ns since year 0, and its resolution.
pub(super) fn camera_clock(path: &Path) -> Option<(u64, u64)> {
    let exif = read(path)?;
    let ascii = |tag| match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(lines) => lines.first().cloned(),
        _ => None,
    };
    let mut time = DateTime::from_ascii(&ascii(Tag::DateTimeOriginal)?).ok()?;
    let sub = ascii(Tag::SubSecTimeOriginal).filter(|s| time.parse_subsec(s).is_ok());
    // Days by the civil calendar (Hinnant), so that midnight is no jump.
    let (m, y) = (u64::from(time.month), u64::from(time.year));
    let (y, m) = if m <= 2 { (y.checked_sub(1)?, m + 9) } else { (y, m - 3) };
    let days = 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + u64::from(time.day);
    let seconds = ((days * 24 + u64::from(time.hour)) * 60 + u64::from(time.minute)) * 60 + u64::from(time.second);
    // Nanoseconds since year 0 would overflow: count from 2000-03-01.
    let since = seconds.checked_sub(730_485 * 86_400)?;
    let nanos = time.nanosecond.map_or(0, u64::from);
    let digits = sub.map_or(0, |s| s.iter().filter(|b| b.is_ascii_digit()).count().min(9) as u32);
    Some((since.checked_mul(1_000_000_000)? + nanos, 10u64.pow(9 - digits)))
}

/// The pose in the data of the picture at `path`; `None` without a GPS position.
pub fn exif_pose(path: &Path) -> Option<ExifPose> {
    let exif = read(path)?;
    let rationals = |tag| match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(v) => Some(v.iter().map(|r| r.to_f64()).collect::<Vec<_>>()),
        _ => None,
    };
    let reference = |tag| match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(lines) => lines.first()?.first().copied(),
        Value::Byte(bytes) => bytes.first().copied(),
        _ => None,
    };
    let degrees = |tag, tag_ref, negative| {
        let v = rationals(tag)?;
        let [d, m, s] = *v.get(..3)? else { return None };
        let sign = if reference(tag_ref) == Some(negative) { -1.0 } else { 1.0 };
        Some(sign * (d + m / 60.0 + s / 3600.0))
    };
    let below = reference(Tag::GPSAltitudeRef) == Some(1);
    let altitude = *rationals(Tag::GPSAltitude)?.first()?;
    let position = Geodetic {
        lat_deg: degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, b'S')?,
        lon_deg: degrees(Tag::GPSLongitude, Tag::GPSLongitudeRef, b'W')?,
        alt_m: if below { -altitude } else { altitude },
    };
    position.is_valid().then(|| ExifPose { position, mount: gimbal(path) })
}

/// DJI's gimbal angles: yaw clockwise from north, pitch −90 straight down, degrees.
fn gimbal(path: &Path) -> Option<DQuat> {
    let mut head = Vec::new();
    disk::regular::open(path).ok()?.take(XMP_WITHIN).read_to_end(&mut head).ok()?;
    let angle = |name: &str| {
        let key = format!("drone-dji:Gimbal{name}Degree=\"");
        let start = head.windows(key.len()).position(|w| w == key.as_bytes())? + key.len();
        let end = start + head.get(start..)?.iter().take(16).position(|b| *b == b'"')?;
        let degrees: f64 = std::str::from_utf8(&head[start..end]).ok()?.parse().ok()?;
        (degrees.abs() <= 360.0).then(|| degrees.to_radians())
    };
    Some(attitude_to_enu(euler_to_ned(angle("Roll")?, angle("Pitch")?, angle("Yaw")?)))
}
