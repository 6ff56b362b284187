//! A flight log beside a card: the exposures that the autopilot reported while it flew.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use geometry::geodesy::Geodetic;
use hal::mavlink::dialect::CAMERA_FEEDBACK_DATA;
use hal::mavlink::{Frame, Framer};
use models::formats::FormatError;
use survey::card::{Attitude, AttitudeSource, Exposure, Fix, dataflash, nadir_rotation};

use crate::error::JobError;

/// What the autopilot's estimate is worth where a CAMERA_FEEDBACK says it, horizontal and vertical, metres: it is taken when
/// the message is made, up to a tenth of a second late.
const SIGMA_M: [f64; 2] = [1.5, 2.0];

/// Exposures of a MAVLink log (`.tlog`) or of an ArduPilot log (`.BIN`), in order.
///
/// # Errors
/// The file cannot be read, or reports no exposures.
pub fn exposures(path: &Path) -> Result<Vec<Exposure>, JobError> {
    let dataflash = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("bin"));
    if dataflash {
        return Ok(dataflash::read(path)?);
    }
    let mut file = File::open(path).map_err(JobError::io(path))?;
    let (mut framer, mut found, mut last) = (Framer::new(), Vec::new(), None);
    loop {
        // The time stamps between the frames of a log are passed over like noise: exposures carry the autopilot's own.
        let read = file.read(framer.space()).map_err(JobError::io(path))?;
        if read == 0 {
            framer.end();
        }
        framer.filled(read);
        while let Some(frame) = framer.next_frame() {
            let Some(feedback) = feedback(&frame) else { continue };
            // A log of two links holds every message twice.
            if last != Some((feedback.img_idx, feedback.time_usec)) {
                last = Some((feedback.img_idx, feedback.time_usec));
                found.extend(exposure(&feedback));
            }
        }
        if read == 0 {
            break;
        }
    }
    match found.is_empty() {
        false => Ok(found),
        true => Err(FormatError::Invalid {
            path: path.to_owned(),
            what: "reports no exposures (CAMERA_FEEDBACK); was the camera triggered by the autopilot?".to_owned(),
        }
        .into()),
    }
}

fn feedback(frame: &Frame<'_>) -> Option<CAMERA_FEEDBACK_DATA> {
    frame.message()
}

fn exposure(f: &CAMERA_FEEDBACK_DATA) -> Option<Exposure> {
    let position =
        Geodetic { lat_deg: f64::from(f.lat) * 1e-7, lon_deg: f64::from(f.lng) * 1e-7, alt_m: f64::from(f.alt_msl) };
    let known = position.is_valid() && (f.lat, f.lng) != (0, 0);
    // The angles are the vehicle's, degrees, whatever carries the camera.
    let rotation = nadir_rotation(f.yaw.into(), f.pitch.into(), f.roll.into());
    let attitude = rotation.is_finite().then_some(Attitude { rotation, source: AttitudeSource::Airframe });
    known.then_some(Exposure { time_s: f.time_usec as f64 * 1e-6, fix: Fix { position, sigma_m: SIGMA_M }, attitude })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_without_exposures_is_one_line() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("a.tlog");
        std::fs::write(&path, [0xFDu8; 5000]).expect("written");
        let error = exposures(&path).expect_err("nothing in it").to_string();
        assert!(error.contains("a.tlog") && error.contains("CAMERA_FEEDBACK") && !error.contains('\n'), "{error}");
        assert!(exposures(&dir.path().join("no.tlog")).is_err());
    }

    #[test]
    fn a_recorded_survey_reports_its_forty_exposures() {
        let Some(log) = needs::shared("data/sitl/run8/survey.tlog") else { return };
        let found = exposures(&log).expect("a log");
        assert_eq!(found.len(), 40);
        assert!(found.windows(2).all(|w| w[0].time_s < w[1].time_s));
    }
}
