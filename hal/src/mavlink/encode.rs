//! Turns messages into MAVLink 2 frames, signed when a key is set, in one reused buffer.

use ::mavlink::{MAVLinkV2MessageRaw, MavHeader, MessageData};

use super::frame::SIGNED;
use super::signing::Signer;

/// One sender on one link: ids, sequence counter, frame buffer.
pub struct Encoder {
    system: u8,
    component: u8,
    sequence: u8,
    raw: MAVLinkV2MessageRaw,
}

impl Encoder {
    /// A sender with these ids.
    pub fn new(system: u8, component: u8) -> Self {
        Self { system, component, sequence: 0, raw: MAVLinkV2MessageRaw::new() }
    }

    /// System and component id.
    pub fn ids(&self) -> (u8, u8) {
        (self.system, self.component)
    }

    /// The counter of the next frame, for a sender that shares it with recorded frames.
    pub fn set_sequence(&mut self, sequence: u8) {
        self.sequence = sequence;
    }

    /// The frame of `message`; signed when `signer` signs what it sends.
    pub fn encode<D: MessageData>(&mut self, message: &D, signer: Option<&mut Signer>) -> &[u8] {
        let header = MavHeader { system_id: self.system.into(), component_id: self.component, sequence: self.sequence };
        self.sequence = self.sequence.wrapping_add(1);
        let signer = signer.filter(|s| s.signs());
        *self.raw.incompatibility_flags_mut() = if signer.is_some() { SIGNED } else { 0 };
        self.raw.serialize_message_data(header, message);
        let len = self.raw.raw_bytes().len();
        let frame = &mut self.raw.as_mut_slice()[..len];
        if let Some(signer) = signer {
            signer.sign(frame);
        }
        frame
    }
}
