//! `gps.csv`: what the aircraft itself knew at each exposure — raw GPS and gimbal angles — as opposed to the
//! reconstructed poses. Training from these is the real case; the reconstructed ones are the yardstick.

use std::collections::HashMap;
use std::path::Path;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DMat3, DQuat, DVec3};

use super::{FormatError, read_bounded};
use crate::camera::{Pose, PosePrior, PoseSigma};

const LIMIT: u64 = 64 << 20;

/// One row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Telemetry {
    /// GPS position as recorded.
    pub position: Geodetic,
    /// Yaw (clockwise from north), pitch, roll of the airframe, degrees, where recorded.
    pub flight_ypr_deg: Option<[f64; 3]>,
    /// Yaw (clockwise from north), pitch (−90 = straight down), roll of the camera, degrees.
    pub gimbal_ypr_deg: [f64; 3],
    /// GPS and gimbal as a camera pose in the data set's ENU frame.
    pub prior: PosePrior,
}

/// Standard deviations of consumer GPS and gimbal angles: twice the rms that the two surveys in the reference data
/// show against bundle adjustment (0.6 m, 3.0° in heading, 1.5° in the view axis), because a common shift of the
/// GPS frame (1.6 m there) does not show in such an rms.
pub const TELEMETRY_SIGMA: PoseSigma = PoseSigma { position_m: [1.2, 1.2, 1.2], rotation_rad: [0.06, 0.06, 0.1] };

/// Camera → ENU rotation of DJI's angles in degrees: yaw clockwise from north, pitch −90 straight down, roll
/// clockwise seen from behind.
pub fn dji_rotation(yaw_deg: f64, pitch_deg: f64, roll_deg: f64) -> DQuat {
    let (sy, cy) = yaw_deg.to_radians().sin_cos();
    let (sp, cp) = pitch_deg.to_radians().sin_cos();
    let (sr, cr) = roll_deg.to_radians().sin_cos();
    let forward = DVec3::new(sy * cp, cy * cp, sp);
    let right = DVec3::new(cy, -sy, 0.0);
    let up = right.cross(forward);
    let (right, up) = (right * cr - up * sr, up * cr + right * sr);
    DQuat::from_mat3(&DMat3::from_cols(right, -up, forward)).normalize()
}

/// Reads `gps.csv`: rows by picture name. Rows without a position or gimbal angles are left out.
///
/// With `origin` the pose comes from latitude, longitude and altitude; without it from the columns `gps_e_m`,
/// `gps_n_m`, `gps_u_m`.
///
/// # Errors
/// The file cannot be read, or a line of it is no telemetry.
pub fn read(path: &Path, origin: Option<Geodetic>) -> Result<HashMap<String, Telemetry>, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let text = std::str::from_utf8(&bytes).map_err(|_| FormatError::invalid(path, "not UTF-8 text"))?;
    let mut lines = text.lines().enumerate();
    let header: Vec<&str> = lines.next().map(|(_, l)| l.split(',').map(str::trim).collect()).unwrap_or_default();
    let column = |name: &str| header.iter().position(|h| *h == name);
    let needed = |name: &'static str| {
        column(name).ok_or_else(|| FormatError::invalid(path, format!("its first line has no column {name:?}")))
    };
    let (image, lat, lon, alt) = (needed("image")?, needed("lat_deg")?, needed("lon_deg")?, needed("alt_m")?);
    let gimbal = [needed("gimbal_yaw_deg")?, needed("gimbal_pitch_deg")?, needed("gimbal_roll_deg")?];
    let flight = [column("flight_yaw_deg"), column("flight_pitch_deg"), column("flight_roll_deg")];
    let enu = [column("gps_e_m"), column("gps_n_m"), column("gps_u_m")];
    let timestamp = column("timestamp");
    let frame = origin.map(EnuFrame::new);
    let mut rows = HashMap::new();
    for (line, text) in lines {
        let cells: Vec<&str> = text.split(',').map(str::trim).collect();
        if cells.len() == 1 && cells[0].is_empty() {
            continue;
        }
        if cells.len() != header.len() {
            let what = format!("line {}: {} cells where the first line names {}", line + 1, cells.len(), header.len());
            return Err(FormatError::invalid(path, what));
        }
        let number = |i: Option<usize>| -> Result<Option<f64>, FormatError> {
            let Some(i) = i.filter(|&i| !cells[i].is_empty()) else { return Ok(None) };
            match cells[i].parse::<f64>() {
                Ok(v) if v.is_finite() => Ok(Some(v)),
                _ => Err(FormatError::invalid(
                    path,
                    format!("line {}: {:?} in column {} is not a number", line + 1, cells[i], header[i]),
                )),
            }
        };
        let three = |c: [Option<usize>; 3]| -> Result<Option<[f64; 3]>, FormatError> {
            Ok(match (number(c[0])?, number(c[1])?, number(c[2])?) {
                (Some(a), Some(b), Some(c)) => Some([a, b, c]),
                _ => None,
            })
        };
        let (Some([lat_deg, lon_deg, alt_m]), Some([y, p, r])) =
            (three([Some(lat), Some(lon), Some(alt)])?, three(gimbal.map(Some))?)
        else {
            continue;
        };
        let position = Geodetic { lat_deg, lon_deg, alt_m };
        if !position.is_valid() {
            return Err(FormatError::invalid(
                path,
                format!("line {}: {lat_deg}, {lon_deg} is not on the earth", line + 1),
            ));
        }
        let center = match frame {
            Some(f) => f.to_enu(position),
            None => match three(enu)? {
                Some(p) => DVec3::from_array(p),
                None => continue,
            },
        };
        let prior = PosePrior {
            time_ns: timestamp.and_then(|i| exif_time_ns(cells[i])).unwrap_or(0),
            pose: Pose { rotation: dji_rotation(y, p, r), center },
            sigma: TELEMETRY_SIGMA,
        };
        let row = Telemetry { position, flight_ypr_deg: three(flight)?, gimbal_ypr_deg: [y, p, r], prior };
        rows.insert(cells[image].to_owned(), row);
    }
    Ok(rows)
}

/// EXIF's `YYYY:MM:DD hh:mm:ss[.fff]` as nanoseconds since 1970, taken as UTC.
pub fn exif_time_ns(text: &str) -> Option<u64> {
    let (date, time) = text.split_once(' ')?;
    let three = |s: &str| -> Option<[f64; 3]> {
        let mut parts = s.split(':').map(|p| p.parse::<f64>().ok());
        Some([parts.next()??, parts.next()??, parts.next()??])
    };
    let ([year, month, day], [hour, minute, second]) = (three(date)?, three(time)?);
    if !(1970.0..2500.0).contains(&year) || !(1.0..=12.0).contains(&month) || !(1.0..=31.0).contains(&day) {
        return None;
    }
    // Days from the civil calendar (Howard Hinnant's chrono algorithm): years start in March.
    let (y, m, d) = (year as u64 - u64::from(month <= 2.0), month as u64, day as u64);
    let (era_year, era) = (y % 400, y / 400);
    let day_of_year = (153 * ((m + 9) % 12) + 2) / 5 + d - 1;
    let days = era * 146_097 + era_year * 365 + era_year / 4 - era_year / 100 + day_of_year - 719_468;
    let seconds = hour * 3600.0 + minute * 60.0 + second;
    (0.0..86_401.0).contains(&seconds).then(|| days * 86_400_000_000_000 + (seconds * 1e9).round() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exif_times_are_unix_times() {
        assert_eq!(exif_time_ns("1970:01:01 00:00:00"), Some(0));
        assert_eq!(exif_time_ns("2018:04:29 12:06:46"), Some(1_525_003_606_000_000_000));
        assert_eq!(exif_time_ns("2016:02:29 23:59:59.5"), Some(1_456_790_399_500_000_000));
        assert_eq!(exif_time_ns("0000:00:00 00:00:00"), None);
    }

    #[test]
    fn a_level_camera_heading_east_sees_east_with_south_on_its_right() {
        let q = dji_rotation(90.0, 0.0, 0.0);
        assert!((q * DVec3::Z - DVec3::X).length() < 1e-12);
        assert!((q * DVec3::X + DVec3::Y).length() < 1e-12);
        assert!((q * DVec3::Y + DVec3::Z).length() < 1e-12);
    }

    #[test]
    fn a_nadir_camera_has_its_heading_at_the_top_and_roll_lowers_the_right_side() {
        let q = dji_rotation(0.0, -90.0, 0.0);
        assert!((q * -DVec3::Y - DVec3::Y).length() < 1e-12, "top of the picture is north");
        assert!((q * DVec3::Z + DVec3::Z).length() < 1e-12);
        let rolled = dji_rotation(0.0, 0.0, 10.0);
        assert!((rolled * DVec3::X).z < -0.17);
    }
}
