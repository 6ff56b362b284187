//! Time messages: TIMESYNC both ways, SYSTEM_TIME, and the boot stamps of everything else.

use super::Autopilot;
use crate::mavlink::Frame;
use crate::mavlink::dialect::{SYSTEM_TIME_DATA, TIMESYNC_DATA};
use crate::time::boot::{Tick, UNIX_FROM_US};

impl Autopilot {
    /// A TIMESYNC request to send now.
    pub fn ask_time(&mut self, now_ns: u64) -> TIMESYNC_DATA {
        // 0 would read as "no request".
        let ts1 = (now_ns as i64).max(1);
        self.asked_ns = Some(ts1);
        TIMESYNC_DATA { tc1: 0, ts1, target_system: self.ids.system, target_component: self.ids.autopilot }
    }

    /// The next answer to a TIMESYNC request of the autopilot.
    pub fn next_answer(&mut self) -> Option<TIMESYNC_DATA> {
        self.answers.pop_front()
    }

    pub(super) fn on_timesync(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let Some(m) = frame.message::<TIMESYNC_DATA>() else { return };
        if m.tc1 == 0 {
            let to_us = m.target_component == 0 || m.target_component == self.ids.own_component;
            if to_us && (m.target_system == 0 || m.target_system == self.ids.system) {
                let answer = TIMESYNC_DATA {
                    tc1: (now_ns as i64).max(1),
                    ts1: m.ts1,
                    target_system: frame.system(),
                    target_component: frame.component(),
                };
                // A full queue means that answers cannot be sent; the autopilot will ask again.
                let _ = self.answers.push_back(answer);
            }
        } else if frame.component() == self.ids.autopilot && self.asked_ns == Some(m.ts1) && m.tc1 > 0 {
            self.asked_ns = None;
            let boot_ns = m.tc1 as u64;
            let boot_ns = self.boot.near_us(boot_ns / 1000).map_or(boot_ns, |near| near + boot_ns % 1000);
            self.clock.round_trip(m.ts1 as u64, now_ns, boot_ns);
        }
    }

    pub(super) fn on_system_time(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let Some(m) = frame.message::<SYSTEM_TIME_DATA>() else { return };
        let boot_ns = self.stamp(m.time_boot_ms, now_ns);
        self.unix.update(m.time_unix_usec, boot_ns);
    }

    /// Boot time of a message stamped in boot milliseconds, ns; every such message feeds the clocks.
    pub(super) fn stamp(&mut self, boot_ms: u32, now_ns: u64) -> u64 {
        match self.boot.tick_ms(boot_ms, now_ns) {
            Tick::Normal(boot_ns) => {
                self.clock.arrival(now_ns, boot_ns);
                boot_ns
            }
            Tick::Restarted(boot_ns) => {
                self.forget();
                self.clock.arrival(now_ns, boot_ns);
                boot_ns
            }
        }
    }

    /// Boot time of a microsecond stamp that may be Unix time or time since boot (32 or 64 bits); `None` when it is 0 or
    /// cannot be placed yet.
    pub(super) fn place_us(&self, us: u64) -> Option<u64> {
        match us {
            0 => None,
            UNIX_FROM_US.. => self.unix.to_boot_ns(us),
            _ => self.boot.near_us(us),
        }
    }
}
