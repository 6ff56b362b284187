//! What a vehicle reports.

use std::collections::VecDeque;
use std::path::PathBuf;

use glam::{DQuat, DVec3};

use super::Complaint;
use crate::camera::Picture;
use crate::matcher::Reason;
use crate::mavlink_camera::ParameterId;
use crate::pose::PoseError;
use crate::trigger::Trigger;

/// Events kept for a runtime that is busy; beyond it the oldest is dropped, counted.
const EVENTS: usize = 256;

/// Something the runtime should know.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// Where the aircraft is; about 10 a second.
    Pose(PoseReport),
    /// An exposure was announced.
    Trigger(Trigger),
    /// A picture with its pose.
    Posed(PosedPicture),
    /// A picture or an exposure that will not become a frame.
    Unmatched(Unmatched),
    /// Something keeps pictures from being posed, or no longer does.
    Complaint {
        /// What.
        what: Complaint,
        /// With its figures, and how to mend it; `None` when it is over.
        line: Option<String>,
    },
    /// The autopilot is silent, or the link is closed; it is being reopened.
    LinkLost,
    /// The autopilot is heard again.
    LinkBack,
    /// A ground station asks for a setting to be changed, to a value within the bounds of its row; to be answered with
    /// [`Vehicle::answer`](super::Vehicle::answer).
    Asked {
        /// Which.
        parameter: ParameterId,
        /// To what.
        value: f32,
    },
}

/// Where the aircraft is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseReport {
    /// Companion's clock, ns.
    pub time_ns: u64,
    /// East, north, up of the mission's origin, metres.
    pub position: DVec3,
    /// East, north, up, m/s.
    pub velocity: DVec3,
    /// Body (forward-left-up) → ENU.
    pub rotation: DQuat,
    /// One standard deviation east, north, up, metres.
    pub position_sigma_m: [f32; 3],
}

/// Where the camera was at mid-exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraPose {
    /// Camera centre, east, north, up of the mission's origin, metres.
    pub position: DVec3,
    /// Camera (OpenCV axes) → ENU.
    pub rotation: DQuat,
    /// One standard deviation east, north, up, metres.
    pub position_sigma_m: [f32; 3],
    /// One standard deviation of rotation about the camera's x, y, z axes, radians.
    pub rotation_sigma_rad: [f32; 3],
}

/// A picture with its pose.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedPicture {
    /// Counter of the exposure's announcement.
    pub sequence: u32,
    /// Mid-exposure on the companion's clock, ns.
    pub time_ns: u64,
    /// Where the camera was.
    pub pose: CameraPose,
    /// Speed at the exposure, m/s.
    pub speed_m_s: f32,
    /// How sure it is that the picture is this exposure's, 0 … 1.
    pub confidence: f32,
    /// The picture, as it came; see [`Picture::load`] for undistorted pixels.
    pub picture: Picture,
}

/// Why something did not become a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnmatchedReason {
    /// Picture and exposure did not find each other.
    Matching(Reason),
    /// The track holds no usable pose for the exposure.
    Pose(PoseError),
    /// The mission's mount needs the gimbal's attitude and the autopilot does not report it.
    NoGimbal,
    /// More matched pictures waited for their pose than there is room for.
    Overflow,
    /// The camera looked further from where the mission's mount points it than `mount.max_tilt_deg`.
    Tilted,
}

/// A picture or an exposure that will not become a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Unmatched {
    /// The exposure's counter, when there is one.
    pub sequence: Option<u32>,
    /// The picture's file, when there is one.
    pub picture: Option<PathBuf>,
    /// Why.
    pub reason: UnmatchedReason,
}

impl std::fmt::Display for Unmatched {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match (&self.sequence, &self.picture) {
            (Some(sequence), Some(picture)) => write!(f, "exposure {sequence} with {}", picture.display())?,
            (Some(sequence), None) => write!(f, "exposure {sequence}")?,
            (None, Some(picture)) => write!(f, "picture {}", picture.display())?,
            (None, None) => write!(f, "picture")?,
        }
        f.write_str(match self.reason {
            UnmatchedReason::Matching(Reason::NoTrigger) => ": no announced exposure",
            UnmatchedReason::Matching(Reason::NoPicture) => ": no picture came",
            UnmatchedReason::Matching(Reason::Duplicate) => ": the same picture again",
            UnmatchedReason::Matching(Reason::Contradictory) => ": its number and its time say different exposures",
            UnmatchedReason::Matching(Reason::Overflow) | UnmatchedReason::Overflow => ": too many waiting",
            UnmatchedReason::Pose(PoseError::Empty) => ": no pose received yet",
            UnmatchedReason::Pose(PoseError::NotYet) => ": the pose messages stopped before it",
            UnmatchedReason::Pose(PoseError::TooOld) => ": older than the poses kept",
            UnmatchedReason::Pose(PoseError::Gap) => ": pose messages too far apart",
            UnmatchedReason::Tilted => ": taken in a turn, the camera tilted beyond mount.max_tilt_deg",
            UnmatchedReason::NoGimbal => ": no gimbal attitude (mount.attitude = \"fixed\" if there is no gimbal)",
        })
    }
}

/// Events until somebody fetches them.
pub(super) struct Events {
    queue: VecDeque<Event>,
    /// Those dropped because nobody did.
    pub dropped: u64,
}

impl Default for Events {
    fn default() -> Self {
        Self { queue: VecDeque::with_capacity(EVENTS), dropped: 0 }
    }
}

impl Events {
    /// Adds an event; of too many the oldest one goes.
    pub fn push(&mut self, event: Event) {
        if self.queue.len() >= EVENTS {
            // Poses are the first to go: the next one says more.
            let oldest_pose = self.queue.iter().position(|e| matches!(e, Event::Pose(_))).unwrap_or(0);
            self.queue.remove(oldest_pose);
            self.dropped += 1;
        }
        self.queue.push_back(event);
    }

    pub fn pop_front(&mut self) -> Option<Event> {
        self.queue.pop_front()
    }

    pub fn len(&self) -> usize {
        self.queue.len()
    }

    pub fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }
}
