//! What strangers send to a flight, by a seed.

use hal::mavlink::dialect::{
    CAMERA_FEEDBACK_DATA, EXTENDED_SYS_STATE_DATA, GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA, MavAutopilot,
    SYS_STATUS_DATA,
};
use hal::mavlink::{Encoder, MessageData};

/// What strangers send by a seed: noise, frames cut anywhere, frames in the autopilot's name. Its numbers are those of splitmix64.
pub struct Stranger(pub u64);

impl Stranger {
    pub fn roll(&mut self, sides: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) % sides.max(1) as u64) as usize
    }

    /// A frame in the name of this system that would end the flight, or spoil it.
    pub fn frame(&mut self, at_ns: u64, system: u8) -> Vec<u8> {
        let mut encoder = Encoder::new(system, 1);
        // Any sequence number.
        for _ in 0..self.roll(256) {
            encoder.encode(&EXTENDED_SYS_STATE_DATA::default(), None);
        }
        let mut encode = |kind: usize, n: usize| match kind {
            0 => encoded(&mut encoder, &SYS_STATUS_DATA { battery_remaining: 3, load: n as u16, ..Default::default() }),
            1 => {
                let time_boot_ms = (at_ns / 1_000_000) as u32;
                encoded(&mut encoder, &GLOBAL_POSITION_INT_DATA { time_boot_ms, lat: n as i32, ..Default::default() })
            }
            2 => {
                let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
                encoded(&mut encoder, &HEARTBEAT_DATA { autopilot, custom_mode: n as u32, ..Default::default() })
            }
            _ => encoded(&mut encoder, &CAMERA_FEEDBACK_DATA { img_idx: n as u16, ..Default::default() }),
        };
        let kind = self.roll(4);
        let mut n = self.roll(1 << 16);
        // Often one whose last byte begins a frame, too.
        let wanted = self.roll(2) == 0;
        let mut frame = encode(kind, n);
        for _ in 0..if wanted { 2000 } else { 0 } {
            if matches!(frame.last(), Some(0xFD | 0xFE)) {
                break;
            }
            n += 1;
            frame = encode(kind, n);
        }
        frame
    }

    /// What a stranger sends at `at_ns`. Whole frames in the autopilot's name come once it has proven itself: before, without
    /// signatures, nobody can tell who is who.
    pub fn datagram(&mut self, at_ns: u64, overheard: &[Vec<u8>]) -> Vec<u8> {
        let cut = |mut frame: Vec<u8>, dice: &mut Self| {
            let most = if dice.roll(2) == 0 { 1 } else { frame.len() - 1 };
            frame.truncate(frame.len() - 1 - dice.roll(most));
            frame
        };
        match self.roll(6) {
            0 => (0..1 + self.roll(300)).map(|_| self.roll(256) as u8).collect(),
            1 => {
                let frame = self.frame(at_ns, 1);
                cut(frame, self)
            }
            2 => {
                let overheard = overheard[self.roll(overheard.len())].clone();
                cut(overheard, self)
            }
            3 => [0xFD, 0xFE, 0xFD, 255][..1 + self.roll(4)].to_vec(),
            _ if at_ns < 4_000_000_000 => vec![0xFD; 1 + self.roll(40)],
            4 => self.frame(at_ns, 1),
            _ => overheard[self.roll(overheard.len())].clone(),
        }
    }
}

fn encoded<D: MessageData>(encoder: &mut Encoder, message: &D) -> Vec<u8> {
    encoder.encode(message, None).to_vec()
}
