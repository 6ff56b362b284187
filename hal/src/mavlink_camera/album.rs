//! What the MAVLink camera remembers of its pictures, so that a CAMERA_IMAGE_CAPTURED that was lost can be asked for again.

use heapless::Deque;

use crate::mavlink::dialect::{CAMERA_IMAGE_CAPTURED_DATA, MavBool};

/// Newest pictures that can be asked for again: 17 minutes at one a second, 40 KiB.
const KEPT: usize = 1024;

/// When and where a picture was taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shot {
    /// Exposure on the autopilot's boot clock, ms.
    pub boot_ms: u32,
    /// Exposure in Unix time, µs; 0 when that is not known.
    pub unix_us: u64,
    /// Latitude, 1e-7 degrees.
    pub lat: i32,
    /// Longitude, 1e-7 degrees.
    pub lon: i32,
    /// Altitude above mean sea level, mm.
    pub alt_mm: i32,
    /// Altitude above the mission's origin, mm.
    pub relative_mm: i32,
}

/// The newest pictures, counted from the first.
#[derive(Default)]
pub(super) struct Album {
    shots: Deque<Shot, KEPT>,
    count: u32,
}

impl Album {
    /// Adds a picture; its index.
    pub(super) fn add(&mut self, shot: Shot) -> u32 {
        if self.shots.is_full() {
            self.shots.pop_front();
        }
        let _ = self.shots.push_back(shot);
        let index = self.count;
        // CAMERA_CAPTURE_STATUS.image_count is an i32.
        self.count = (self.count + 1).min(i32::MAX as u32);
        index
    }

    /// Pictures so far.
    pub(super) fn count(&self) -> u32 {
        self.count
    }

    /// The announcement of a picture; `None` when it was not taken or is no longer kept.
    pub(super) fn message(&self, index: u32) -> Option<CAMERA_IMAGE_CAPTURED_DATA> {
        let oldest = self.count - self.shots.len() as u32;
        let shot = self.shots.iter().nth(index.checked_sub(oldest)? as usize)?;
        Some(CAMERA_IMAGE_CAPTURED_DATA {
            time_boot_ms: shot.boot_ms,
            time_utc: shot.unix_us,
            lat: shot.lat,
            lon: shot.lon,
            alt: shot.alt_mm,
            relative_alt: shot.relative_mm,
            // The attitude in the message's frame is not known.
            q: [f32::NAN; 4],
            image_index: index as i32,
            capture_result: MavBool::MAV_BOOL_TRUE,
            ..CAMERA_IMAGE_CAPTURED_DATA::default()
        })
    }
}
