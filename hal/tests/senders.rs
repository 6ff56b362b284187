//! Who said what on a link on which several speak: nobody spoils or repeats away what another one says.
#![allow(clippy::expect_used, reason = "a test fails by panicking")]

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::time::Duration;

use hal::error::HalError;
use hal::mavlink::channel::Channel;
use hal::mavlink::dialect::SYSTEM_TIME_DATA;
use hal::mavlink::{Encoder, Signer, SigningMode};
use hal::traits::{Flow, Link, Received};

/// A link on which several speak, as the test says: from which port, how it belongs to what came from there, and what.
struct Said(VecDeque<(u16, Flow, Vec<u8>)>);

fn peer(port: u16) -> Option<SocketAddr> {
    Some(SocketAddr::from(([127, 0, 0, 1], port)))
}

impl Link for Said {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], _: Duration) -> Result<Received, HalError> {
        let Some((port, flow, bytes)) = self.0.pop_front() else { return Ok(Received::default()) };
        into[..bytes.len()].copy_from_slice(&bytes);
        Ok(Received { bytes: bytes.len(), peer: peer(port), flow, ..Received::default() })
    }

    fn write(&mut self, _: &[u8]) -> Result<(), HalError> {
        Ok(())
    }

    fn senders(&self) -> usize {
        2
    }
}

/// How many frames are taken of what is said, where the one at port 1 is believed.
fn believed(signer: Signer, said: Vec<(u16, Flow, Vec<u8>)>) -> usize {
    let mut channel = Channel::new(Said(said.into()), 1, 191, signer);
    let mut count = 0;
    while channel.fill(Duration::ZERO).expect("read") {
        let is_believed = channel.peer() == peer(1);
        while channel.next_frame_if(|_| is_believed).is_some() {
            count += 1;
        }
    }
    count
}

#[test]
fn a_frame_that_comes_in_parts_is_found_whoever_speaks_between_them() {
    let frame = Encoder::new(1, 1).encode(&SYSTEM_TIME_DATA::default(), None).to_vec();
    let parts = |at: usize| {
        let (begun, rest) = frame.split_at(at);
        // What the stranger says looks like a frame's beginning.
        let between = vec![0xFD; at];
        [(1, begun.to_vec()), (2, between), (1, rest.to_vec())].map(|(port, bytes)| (port, Flow::Continues, bytes))
    };
    assert_eq!(believed(Signer::off(), (1..frame.len()).flat_map(parts).collect()), frame.len() - 1);
}

/// Whoever hears the autopilot and repeats its frames faster than they come would silence it.
#[test]
fn a_copy_of_a_signed_frame_from_somebody_else_makes_no_replay_of_the_frame_itself() {
    let sign = || Signer::new(SigningMode::Require, [7; 32], 0, 5);
    let (mut encoder, mut signer) = (Encoder::new(1, 1), sign());
    let mut frame = || encoder.encode(&SYSTEM_TIME_DATA::default(), Some(&mut signer)).to_vec();
    let frames: Vec<_> = (0..20).map(|_| frame()).collect();
    let said = |ports: [u16; 2]| {
        let twice = move |frame: &Vec<u8>| ports.map(|port| (port, Flow::Whole, frame.clone()));
        frames.iter().flat_map(twice).collect()
    };
    assert_eq!(believed(sign(), said([2, 1])), frames.len());
    assert_eq!(believed(sign(), said([1, 1])), frames.len(), "its own copy is one");
}
