//! What the HAL met: every loss, refusal and repair is counted under its own name, none is silent.

/// What the link brought and took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "std", derive(serde::Serialize))]
pub struct LinkCounters {
    /// MAVLink frames with a right checksum.
    pub frames: u64,
    /// Damaged stretches of the stream.
    pub damaged: u64,
    /// Bytes passed over while looking for the next frame.
    pub skipped_bytes: u64,
    /// Frames of unknown messages or protocol flags.
    pub unknown: u64,
    /// Frames missing by the autopilot's sequence counter.
    pub lost: u64,
    /// Frames of other systems, and of gimbals and cameras that are not the one whose pictures come.
    pub foreign: u64,
    /// Frames of peers that are not the pinned autopilot.
    pub refused_peers: u64,
    /// Unsigned frames refused.
    pub unsigned: u64,
    /// Frames refused for a wrong signature.
    pub wrong_key: u64,
    /// Frames refused because their signing time stamp did not grow.
    pub replayed: u64,
    /// Frames sent, and those the link would not take.
    pub sent: u64,
    /// Frames the link would not take.
    pub send_failed: u64,
    /// How often the link was lost.
    pub link_losses: u64,
}

/// What the autopilot said of where it was and what time it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "std", derive(serde::Serialize))]
pub struct TelemetryCounters {
    /// Messages with NaN, infinite or impossible values, not used.
    pub impossible: u64,
    /// Positions before the first fix (0, 0), not used.
    pub unfixed: u64,
    /// Positions used.
    pub positions: u64,
    /// Attitudes used.
    pub attitudes: u64,
    /// Gimbal attitudes used.
    pub gimbals: u64,
    /// Single attitudes or positions rejected as spikes.
    pub spikes: u64,
    /// Steps of the position estimate, and of its origin.
    pub position_steps: u64,
    /// Restarts or jumps of the autopilot's clock.
    pub clock_restarts: u64,
    /// Steps of GPS time or of the clock mapping.
    pub clock_steps: u64,
    /// Clock samples not used.
    pub clock_rejected: u64,
}

/// Exposures that the autopilot announced.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "std", derive(serde::Serialize))]
pub struct ExposureCounters {
    /// Exposures announced.
    pub triggers: u64,
    /// An exposure announced again, or by a second message.
    pub trigger_duplicates: u64,
    /// Announcements missing by their counter.
    pub trigger_gaps: u64,
    /// Announcements with an impossible time stamp, taken at their arrival.
    pub trigger_times_mended: u64,
    /// Exposures without a picture.
    pub triggers_unmatched: u64,
    /// Exposures left out because the camera was tilted beyond `mount.max_tilt_deg`.
    pub exposures_tilted: u64,
    /// Exposures or pictures without a usable pose.
    pub poseless: u64,
}

/// Pictures that the camera gave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "std", derive(serde::Serialize))]
pub struct PictureCounters {
    /// Complete pictures seen.
    pub pictures: u64,
    /// Pictures that were broken, or never completed.
    pub pictures_broken: u64,
    /// Pictures of a video device that never came, by the driver's numbers.
    pub pictures_lost: u64,
    /// Pictures left out because they were black.
    pub pictures_black: u64,
    /// Pictures left out because more than half of them was clipped.
    pub pictures_overexposed: u64,
    /// Pictures left out because they were of one colour.
    pub pictures_constant: u64,
    /// A picture that was there before.
    pub picture_duplicates: u64,
    /// Pictures without an exposure.
    pub pictures_unmatched: u64,
    /// Pictures that came out of order or late.
    pub pictures_late: u64,
    /// Pictures that found their exposure only when all were compared with all.
    pub pictures_reconciled: u64,
}

/// Totals since start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "std", derive(serde::Serialize))]
pub struct HalCounters {
    /// Counters of the link.
    #[cfg_attr(feature = "std", serde(flatten))]
    pub link: LinkCounters,
    /// Counters of the telemetry.
    #[cfg_attr(feature = "std", serde(flatten))]
    pub telemetry: TelemetryCounters,
    /// Counters of the exposures.
    #[cfg_attr(feature = "std", serde(flatten))]
    pub exposures: ExposureCounters,
    /// Counters of the pictures.
    #[cfg_attr(feature = "std", serde(flatten))]
    pub pictures: PictureCounters,
    /// Frames given to the runtime.
    pub posed_frames: u64,
    /// Of those, frames with the pose of their EXIF data.
    pub exif_poses: u64,
    /// Events dropped because nobody fetched them.
    pub events_dropped: u64,
}
