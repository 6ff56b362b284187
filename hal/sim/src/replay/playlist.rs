//! Posed photographs in the order they were taken, and the flight that passes through them.

use std::path::PathBuf;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};

use super::ReplaySettings;
use crate::SimError;
use crate::aircraft::{Exposure, Flight};
use crate::axes::{camera_to_enu, from_degrees, gimbal_to_ned};
use crate::track::{Sample, Track};
use hal::frames::euler_to_ned;

/// Standing still before the first and after the last picture, seconds.
const HOVER: f64 = 4.0;
/// Two pictures are at least this far apart, seconds: recorded times often have a resolution of one second.
const SHORTEST_GAP: f64 = 0.2;

/// One photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaylistItem {
    /// Middle of its exposure, seconds since any start.
    pub time_s: f64,
    /// Where the camera was.
    pub position: Geodetic,
    /// Vehicle FRD → NED.
    pub vehicle: DQuat,
    /// Gimbal FRD (x along the optical axis) → NED.
    pub gimbal: DQuat,
    /// The file.
    pub picture: PathBuf,
}

impl PlaylistItem {
    /// From telemetry as DJI writes it: yaw (clockwise from north), pitch (−90 = straight down) and roll in degrees.
    pub fn from_angles(
        time_s: f64,
        position: Geodetic,
        vehicle_yaw_pitch_roll: [f64; 3],
        gimbal_yaw_pitch_roll: [f64; 3],
        picture: PathBuf,
    ) -> Self {
        let [vy, vp, vr] = vehicle_yaw_pitch_roll;
        let [gy, gp, gr] = gimbal_yaw_pitch_roll;
        let (vehicle, gimbal) = (from_degrees(vy, vp, vr), from_degrees(gy, gp, gr));
        Self { time_s, position, vehicle, gimbal, picture }
    }

    /// From a camera pose: `camera` is camera (OpenCV) → ENU; the vehicle flies level towards the picture's upper edge.
    pub fn from_camera(time_s: f64, position: Geodetic, camera: DQuat, picture: PathBuf) -> Self {
        let up = camera * DVec3::NEG_Y + camera * DVec3::Z;
        let vehicle = euler_to_ned(0.0, 0.0, up.x.atan2(up.y));
        Self { time_s, position, vehicle, gimbal: gimbal_to_ned(camera), picture }
    }

    /// Camera (OpenCV) → ENU.
    pub fn camera_to_enu(&self) -> DQuat {
        camera_to_enu(self.gimbal)
    }
}

/// Photographs in order of time.
#[derive(Clone, Debug, PartialEq)]
pub struct Playlist {
    /// Home: altitudes relative to home refer to it.
    pub home: Geodetic,
    /// The photographs.
    pub items: Vec<PlaylistItem>,
}

impl Playlist {
    /// The flight through all photographs, starting [`HOVER`] seconds before the first.
    pub(super) fn flight(&self, settings: &ReplaySettings) -> Result<Flight, SimError> {
        let wrong = |why: String| SimError::Settings { what: "playlist", why };
        let Some(first) = self.items.first() else { return Err(wrong("holds no pictures".into())) };
        let frame = EnuFrame::new(self.home);
        let (mut samples, mut exposures): (Vec<Sample>, Vec<Exposure>) = (Vec::new(), Vec::new());
        let longest = settings.longest_gap_s.max(SHORTEST_GAP);
        let (mut time_s, mut last_s) = (HOVER, first.time_s);
        for item in &self.items {
            let name = item.picture.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let finite = item.time_s.is_finite() && item.vehicle.is_finite() && item.gimbal.is_finite();
            if !finite || !item.position.is_valid() || name.is_empty() {
                return Err(wrong(format!("{}: time, position or attitude is not a number", item.picture.display())));
            }
            if item.time_s < last_s {
                return Err(wrong(format!("{name} was taken before the picture above it; sort by time")));
            }
            if !exposures.is_empty() {
                time_s += (item.time_s - last_s).clamp(SHORTEST_GAP, longest);
            }
            last_s = item.time_s;
            samples.push(Sample {
                time_s,
                position: frame.to_enu(item.position),
                velocity: DVec3::ZERO,
                attitude: item.vehicle.normalize(),
                gimbal: item.gimbal.normalize(),
            });
            let trigger_s = time_s - settings.shutter_delay_s;
            exposures.push(Exposure { trigger_s, middle_s: time_s, ready_s: time_s + settings.transfer_s, name });
        }
        let still = |s: &Sample, time_s| Sample { time_s, ..*s };
        samples.insert(0, still(&samples[0], 0.0));
        samples.push(still(&samples[samples.len() - 1], time_s + HOVER));
        let track = Track::smooth(samples).ok_or_else(|| wrong("times or positions are not numbers".into()))?;
        Ok(Flight { origin: self.home, truth: track.clone(), reported: track, exposures })
    }
}
