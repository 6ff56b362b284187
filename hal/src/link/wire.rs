//! A wire in memory: what one end writes, the other reads, at once and in order. For flights on a simulated clock, where a
//! kernel's buffers would let wall-clock time in.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::NOTHING;
use crate::error::HalError;
use crate::traits::{Link, Received};

/// Bytes in flight; a reader that falls behind by more loses frames, as on a serial port.
const CAPACITY: usize = 64 << 10;

type Bytes = Arc<Mutex<VecDeque<u8>>>;

/// One end of a wire.
pub struct WireLink {
    incoming: Bytes,
    outgoing: Bytes,
}

impl WireLink {
    /// Both ends of a new wire.
    pub fn pair() -> (Self, Self) {
        let (a, b) = (Bytes::default(), Bytes::default());
        (Self { incoming: a.clone(), outgoing: b.clone() }, Self { incoming: b, outgoing: a })
    }
}

impl Link for WireLink {
    type Error = HalError;

    /// Never waits: on a simulated clock nothing comes while nobody moves it.
    fn read(&mut self, into: &mut [u8], _timeout: Duration) -> Result<Received, HalError> {
        let mut bytes = self.incoming.lock().unwrap_or_else(PoisonError::into_inner);
        let count = bytes.len().min(into.len());
        if count == 0 {
            return Ok(NOTHING);
        }
        for (to, from) in into.iter_mut().zip(bytes.drain(..count)) {
            *to = from;
        }
        Ok(Received { bytes: count, ..NOTHING })
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        let mut bytes = self.outgoing.lock().unwrap_or_else(PoisonError::into_inner);
        if bytes.len() + frame.len() > CAPACITY {
            return Err(HalError::Full { address: "wire".into() });
        }
        bytes.extend(frame);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_arrive_in_order_and_a_full_wire_refuses_whole_frames() {
        let (mut a, mut b) = WireLink::pair();
        let mut buffer = [0; 4];
        a.write(b"abcdef").expect("room");
        assert_eq!(b.read(&mut buffer, Duration::ZERO).expect("open").bytes, 4);
        assert_eq!((&buffer, b.read(&mut buffer.clone(), Duration::ZERO).expect("open").bytes), (b"abcd", 2));
        assert_eq!(b.read(&mut buffer, Duration::ZERO).expect("open").bytes, 0);
        b.write(&vec![7; CAPACITY]).expect("room");
        assert!(b.write(b"x").is_err());
        assert_eq!(a.read(&mut buffer, Duration::ZERO).expect("open").bytes, 4);
    }
}
