//! MAVLink on the wire: framing with damage counted, signing, encoding. Meaning is given to the messages in
//! [`crate::autopilot`]; the dialect's types come from the `mavlink` crate.

pub mod encode;
pub mod frame;
pub mod signing;

#[cfg(feature = "std")]
pub mod channel;
#[cfg(feature = "std")]
pub mod signing_store;

pub use ::mavlink::MessageData;
pub use ::mavlink::dialects::ardupilotmega as dialect;

pub use encode::Encoder;
pub use frame::{Frame, FrameCounters, Framer};
pub use signing::{Refusal, Signer, SigningMode};
