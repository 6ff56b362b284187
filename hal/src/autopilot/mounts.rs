//! Which of several gimbals carries the camera: one is believed, the others are named and left out. Angles of two mounts, or of
//! one mount as two components report it, are never interpolated into each other.

use heapless::Vec;

/// Gimbals told apart.
const GIMBALS: usize = 8;

/// A gimbal as one component reports it. Ordered by who is believed: the lowest device, and the autopilot's report of it, whose
/// clock is that of the track.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Gimbal {
    /// Device id: 1 to 6 hang on the autopilot, others are components of their own.
    pub device: u8,
    /// Reported by the device itself.
    pub by_itself: bool,
    /// The component that reports.
    pub component: u8,
}

impl Gimbal {
    /// Of a GIMBAL_DEVICE_ATTITUDE_STATUS: a device id of 0 means the sender.
    pub(super) fn new(component: u8, device_id: u8, autopilot: u8) -> Self {
        Self {
            device: if device_id == 0 { component } else { device_id },
            by_itself: component != autopilot,
            component,
        }
    }
}

/// The gimbals heard.
#[derive(Default)]
pub(super) struct Mounts {
    /// Device id of the mission; 0 = any.
    wanted: u8,
    chosen: Option<Gimbal>,
    others: Vec<Gimbal, GIMBALS>,
}

/// What to do with a report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Believed {
    /// It goes on the track.
    Yes,
    /// It is the first of a gimbal that is believed instead of the one before.
    Instead,
    /// It is left out.
    No,
}

impl Mounts {
    pub(super) fn of(wanted: u8) -> Self {
        Self { wanted, ..Self::default() }
    }

    /// As before anything was heard.
    pub(super) fn forgotten(&self) -> Self {
        Self::of(self.wanted)
    }

    pub(super) fn chosen(&self) -> (Option<Gimbal>, &[Gimbal]) {
        (self.chosen, &self.others)
    }

    pub(super) fn hear(&mut self, gimbal: Gimbal) -> Believed {
        if self.chosen == Some(gimbal) {
            return Believed::Yes;
        }
        let wanted = self.wanted == 0 || self.wanted == gimbal.device;
        if wanted && self.chosen.is_none_or(|chosen| gimbal < chosen) {
            self.others.retain(|other| *other != gimbal);
            let before = self.chosen.replace(gimbal);
            return match before {
                Some(before) => {
                    self.leave_out(before);
                    Believed::Instead
                }
                None => Believed::Yes,
            };
        }
        self.leave_out(gimbal);
        Believed::No
    }

    fn leave_out(&mut self, gimbal: Gimbal) {
        if !self.others.contains(&gimbal) {
            // A ninth one is left out without a name.
            let _ = self.others.push(gimbal);
        }
    }
}
