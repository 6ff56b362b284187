//! Frames over a link: what a simulator, a test or the vehicle driver needs to talk MAVLink, signing included.

use std::net::SocketAddr;
use std::ops::Range;
use std::time::Duration;

use super::{Encoder, Frame, FrameCounters, Framer, MessageData, Refusal, Signer};
use crate::error::{Error, ErrorKind};
use crate::traits::{Flow, Link};

/// Read at once at most: a datagram, or what a serial driver's buffer holds.
const STAGE: usize = 4096;

/// What happened on a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ChannelCounters {
    /// What the framer met.
    pub frames: FrameCounters,
    /// Frames sent.
    pub sent: u64,
    /// Frames the link would not take.
    pub send_failed: u64,
    /// Unsigned frames refused.
    pub unsigned: u64,
    /// Frames with a wrong signature.
    pub wrong_key: u64,
    /// Frames whose signing time stamp did not grow.
    pub replayed: u64,
}

/// A peer and the frame it is half through.
struct Sender {
    peer: Option<SocketAddr>,
    framer: Framer,
    /// The larger, the later it was heard.
    heard: u64,
}

/// MAVLink over one link. Every sender has its own framer, so that nobody completes a frame that somebody else began.
pub struct Channel<L: Link> {
    link: L,
    senders: Vec<Sender>,
    /// Whose bytes were read last.
    current: usize,
    reads: u64,
    stage: Box<[u8; STAGE]>,
    /// What of it is not yet in the sender's framer.
    staged: Range<usize>,
    /// Nothing follows what is staged: it is a datagram.
    whole: bool,
    encoder: Encoder,
    signer: Signer,
    received_ns: Option<u64>,
    peer: Option<SocketAddr>,
    counters: ChannelCounters,
}

impl<L: Link> Channel<L> {
    /// A channel that sends as `system`, `component`.
    pub fn new(link: L, system: u8, component: u8, signer: Signer) -> Self {
        let sender = || Sender { peer: None, framer: Framer::new(), heard: 0 };
        Self {
            senders: (0..link.senders().max(1)).map(|_| sender()).collect(),
            link,
            current: 0,
            reads: 0,
            stage: Box::new([0; STAGE]),
            staged: 0..0,
            whole: false,
            encoder: Encoder::new(system, component),
            signer,
            received_ns: None,
            peer: None,
            counters: ChannelCounters::default(),
        }
    }

    /// The link below.
    pub fn link(&self) -> &L {
        &self.link
    }

    /// The link below, e.g. to write damaged bytes on purpose.
    pub fn link_mut(&mut self) -> &mut L {
        &mut self.link
    }

    /// Sends with these ids from now on.
    pub fn set_ids(&mut self, system: u8, component: u8) {
        if self.encoder.ids() != (system, component) {
            self.encoder = Encoder::new(system, component);
        }
    }

    /// Says that no more bytes will come; a last call of [`Channel::next_frame`] finds what half a frame was hiding.
    pub fn end(&mut self) {
        self.senders.iter_mut().for_each(|s| s.framer.end());
    }

    /// Forgets half a frame, for a link that was reopened.
    pub fn resynchronise(&mut self) {
        self.senders.iter_mut().for_each(|s| s.framer.reset());
    }

    /// The signing state.
    pub fn signer_mut(&mut self) -> &mut Signer {
        &mut self.signer
    }

    /// What happened so far.
    pub fn counters(&self) -> ChannelCounters {
        let frames = self.senders.iter().map(|s| s.framer.counters()).fold(FrameCounters::default(), |a, b| a + b);
        ChannelCounters { frames, ..self.counters }
    }

    /// When the frame returned last was received, for recordings; `None` on live links.
    pub fn received_ns(&self) -> Option<u64> {
        self.received_ns
    }

    /// Who sent what was read last, on links where anybody may.
    pub fn peer(&self) -> Option<SocketAddr> {
        self.peer
    }

    /// Reads what the link has, waiting `timeout` at most; true when something came. Then call [`Channel::next_frame`]
    /// until it returns `None`.
    ///
    /// # Errors
    /// The link's.
    pub fn fill(&mut self, timeout: Duration) -> Result<bool, L::Error> {
        if !self.staged.is_empty() {
            return Ok(true);
        }
        let received = self.link.read(&mut self.stage[..], timeout)?;
        (self.received_ns, self.peer) = (received.time_ns, received.peer);
        if received.bytes == 0 {
            return Ok(false);
        }
        self.reads += 1;
        self.current = self.sender_of(received.peer);
        self.staged = 0..received.bytes.min(STAGE);
        self.whole = received.flow == Flow::Whole;
        if let Some(sender) = self.senders.get_mut(self.current) {
            if received.flow != Flow::Continues || sender.peer != received.peer {
                sender.framer.reset();
            }
            (sender.peer, sender.heard) = (received.peer, self.reads);
        }
        Ok(true)
    }

    /// The framer of `peer`; of a new one, the place of whom nothing was heard for the longest time.
    fn sender_of(&self, peer: Option<SocketAddr>) -> usize {
        let known = self.senders.iter().position(|s| s.peer == peer && s.heard > 0);
        known.or_else(|| self.senders.iter().enumerate().min_by_key(|(_, s)| s.heard).map(|(i, _)| i)).unwrap_or(0)
    }

    /// Moves staged bytes into the sender's framer; false when there are none.
    fn feed(&mut self) -> bool {
        let Some(sender) = self.senders.get_mut(self.current) else { return false };
        if !self.staged.is_empty() {
            self.staged.start += sender.framer.push(&self.stage[self.staged.clone()]);
            return true;
        }
        // Half a frame dies with its datagram, and what it hid is found.
        let ends = std::mem::take(&mut self.whole);
        if ends {
            sender.framer.end();
        }
        ends
    }

    /// The next good frame of what was read; refused ones are counted and passed over.
    pub fn next_frame(&mut self) -> Option<Frame<'_>> {
        self.next_frame_if(|_| true)
    }

    /// The next good frame of a sender whom `admit` believes. Nothing is remembered of other frames, of which a stranger may send copies.
    pub fn next_frame_if(&mut self, mut admit: impl FnMut(&Frame<'_>) -> bool) -> Option<Frame<'_>> {
        // Two steps because a frame borrows the framer: first whether it is acceptable, then its bytes.
        loop {
            let Some(frame) = self.senders.get_mut(self.current)?.framer.next_frame() else {
                if self.feed() {
                    continue;
                }
                return None;
            };
            match self.signer.verify(&frame) {
                Ok(stamp) => {
                    if admit(&frame) {
                        self.signer.note(stamp);
                        return self.senders.get(self.current)?.framer.last_frame();
                    }
                }
                Err(Refusal::Unsigned) => self.counters.unsigned += 1,
                Err(Refusal::WrongKey | Refusal::TooManyStreams) => self.counters.wrong_key += 1,
                Err(Refusal::Replayed) => self.counters.replayed += 1,
            }
        }
    }

    /// Sends `message`. A link that is full drops the frame, counted; a lost one is the error.
    ///
    /// # Errors
    /// The link's, except `ErrorKind::Busy`.
    pub fn send<D: MessageData>(&mut self, message: &D) -> Result<(), L::Error> {
        let frame = self.encoder.encode(message, Some(&mut self.signer));
        match self.link.write(frame) {
            Ok(()) => {
                self.counters.sent += 1;
                Ok(())
            }
            Err(e) => {
                self.counters.send_failed += 1;
                if e.kind() == ErrorKind::Busy { Ok(()) } else { Err(e) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{PtyLink, SerialLink};
    use crate::mavlink::SigningMode;
    use crate::mavlink::dialect::SYSTEM_TIME_DATA;

    fn pair(near: Signer, far: Signer) -> (Channel<PtyLink>, Channel<SerialLink>) {
        let pty = PtyLink::create(None).expect("a pty");
        let serial = SerialLink::open(pty.path(), 921_600).expect("its far end");
        (Channel::new(pty, 1, 1, near), Channel::new(serial, 1, 191, far))
    }

    fn count(channel: &mut Channel<impl Link>) -> usize {
        let mut n = 0;
        while channel.fill(Duration::from_millis(50)).is_ok_and(|some| some) {
            while let Some(frame) = channel.next_frame() {
                n += usize::from(frame.message::<SYSTEM_TIME_DATA>().is_some());
            }
        }
        n
    }

    #[test]
    fn a_pty_carries_frames_both_ways() {
        let (mut near, mut far) = pair(Signer::off(), Signer::off());
        for _ in 0..20 {
            near.send(&SYSTEM_TIME_DATA::default()).expect("sent");
            far.send(&SYSTEM_TIME_DATA::default()).expect("sent");
        }
        assert_eq!((count(&mut near), count(&mut far)), (20, 20));
    }

    #[test]
    fn frames_signed_with_another_key_do_not_pass() {
        let sign = |key| Signer::new(SigningMode::Require, [key; 32], 0, 5);
        let (mut near, mut far) = pair(sign(1), sign(2));
        near.send(&SYSTEM_TIME_DATA::default()).expect("sent");
        assert_eq!((count(&mut far), far.counters().wrong_key), (0, 1));
    }

    #[test]
    fn a_line_nobody_reads_drops_frames_instead_of_blocking() {
        let (mut near, _far) = pair(Signer::off(), Signer::off());
        for _ in 0..10_000 {
            near.send(&SYSTEM_TIME_DATA::default()).expect("dropped, not failed");
        }
        assert!(near.counters().send_failed > 0);
    }
}
