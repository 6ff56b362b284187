//! Who is the autopilot, when several speak on one link. A UDP port is open to everybody; MAVLink without signing is believed
//! by what it says. So a peer has to prove itself, by several messages that agree over seconds, before anything it says is
//! taken, and is pinned from then on. An autopilot that has fallen silent can be replaced by one at the same host that goes
//! on where it stopped, and takes its place back when it speaks again.

use core::net::SocketAddr;

use heapless::Vec;

use crate::mavlink::dialect::{
    ATTITUDE_DATA, ATTITUDE_QUATERNION_DATA, GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA, MavAutopilot, MavModeFlag,
    SYSTEM_TIME_DATA,
};
use crate::mavlink::{Frame, MessageData};

/// Peers watched at the same time.
const CANDIDATES: usize = 8;
/// Heartbeats that prove a peer, as far apart as an autopilot's are at least, and messages stamped by one growing boot clock.
const HEARTBEATS: u8 = 3;
const HEARTBEAT_APART_NS: u64 = 500_000_000;
const STAMPED: u8 = 3;
/// An autopilot that only sends heartbeats has to send this many.
const HEARTBEATS_ALONE: u8 = 10;
/// Another one may take over when the pinned one has been silent for this long.
const SILENT_NS: u64 = 5_000_000_000;
/// And its boot clock stands where the pinned one's would, give or take this, or has just started.
const CLOCK_SLACK_MS: u64 = 10_000;
const JUST_STARTED_MS: u64 = 120_000;

/// Somebody who claims to be the autopilot: an address (`None` on links without) and MAVLink ids.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Identity {
    address: Option<SocketAddr>,
    system: u8,
    component: u8,
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    who: Identity,
    last_ns: u64,
    heartbeat_ns: Option<u64>,
    heartbeats: u8,
    boot_ms: Option<u32>,
    stamped: u8,
    is_armed: bool,
}

impl Identity {
    fn ids(&self) -> (u8, u8) {
        (self.system, self.component)
    }
}

/// The pinned autopilot.
#[derive(Clone, Copy, Debug)]
struct Pinned {
    who: Identity,
    last_ns: u64,
    /// Its boot clock, and when that was heard.
    boot: Option<(u32, u64)>,
    /// As its last heartbeat says: an armed one does not restart.
    is_armed: bool,
}

/// What to do with a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It is the autopilot's.
    Take,
    /// It is; what was taken before came from somebody else and is void.
    TakeAfresh,
    /// It is not.
    Refuse,
    /// Nobody has proven to be the autopilot yet; this one claims to be.
    Claims,
    /// Nobody has, and this one does not claim to be.
    Nobody,
}

/// Tells the autopilot from others.
#[derive(Debug)]
pub struct Peers {
    /// The vehicle's system id; 0 = whichever comes first.
    system: u8,
    pinned: Option<Pinned>,
    /// Whom the pinned one has replaced.
    replaced: Option<Pinned>,
    candidates: Vec<Candidate, CANDIDATES>,
}

impl Peers {
    /// Nobody is known yet; `system` is the mission's, 0 takes the first.
    pub fn new(system: u8) -> Self {
        Self { system, pinned: None, replaced: None, candidates: Vec::new() }
    }

    /// The pinned autopilot's address, on links that have any.
    pub fn address(&self) -> Option<SocketAddr> {
        self.pinned?.who.address
    }

    /// Somebody has proven to be the autopilot.
    pub fn is_pinned(&self) -> bool {
        self.pinned.is_some()
    }

    /// Judges a frame that came from `address` at `now_ns`.
    pub fn judge(&mut self, address: Option<SocketAddr>, frame: &Frame<'_>, now_ns: u64) -> Verdict {
        if address.is_none() {
            // One line, one autopilot: its ids are all there is to go by.
            return Verdict::Take;
        }
        let ids = (frame.system(), frame.component());
        if let Some(pinned) = &mut self.pinned
            && pinned.who.address == address
        {
            if pinned.who.ids() == ids {
                pinned.hear(frame, now_ns);
            }
            return Verdict::Take;
        }
        if let Some(mut first) = self.replaced.filter(|r| r.who.address == address && r.who.ids() == ids)
            && boot_ms(frame).is_some_and(|ms| first.goes_on_at(ms, now_ns))
        {
            first.hear(frame, now_ns);
            (self.pinned, self.replaced) = (Some(first), None);
            return Verdict::TakeAfresh;
        }
        let claims = self.system == 0 || frame.system() == self.system;
        let proven = if claims { self.watch(address, frame, now_ns) } else { None };
        match (self.pinned, proven) {
            (None, Some(candidate)) => {
                self.pin(&candidate, now_ns);
                Verdict::Take
            }
            (None, None) if claims && is_autopilot(frame) => Verdict::Claims,
            (None, None) => Verdict::Nobody,
            (Some(pinned), Some(candidate)) if pinned.may_be_replaced_by(&candidate, now_ns) => {
                // Of several in a row the first stays the one that may come back.
                self.replaced = self.replaced.or(Some(pinned));
                self.pin(&candidate, now_ns);
                Verdict::Take
            }
            (Some(_), _) => Verdict::Refuse,
        }
    }

    fn pin(&mut self, candidate: &Candidate, now_ns: u64) {
        let boot = candidate.boot_ms.map(|ms| (ms, now_ns));
        let is_armed = candidate.is_armed;
        self.pinned = Some(Pinned { who: candidate.who, last_ns: now_ns, boot, is_armed });
        self.candidates.clear();
    }

    /// Notes what a peer that is not pinned says; the peer, once it has proven itself.
    fn watch(&mut self, address: Option<SocketAddr>, frame: &Frame<'_>, now_ns: u64) -> Option<Candidate> {
        let who = Identity { address, system: frame.system(), component: frame.component() };
        let index = match self.candidates.iter().position(|c| c.who == who) {
            Some(index) => index,
            None if !is_autopilot(frame) => return None,
            None => {
                if self.candidates.is_full() {
                    // The one that has shown the least makes room, the newest first: a flood of names displaces itself.
                    let shown =
                        |c: &Candidate| (c.heartbeats.saturating_add(c.stamped.min(STAMPED)), u64::MAX - c.last_ns);
                    let least = self.candidates.iter().enumerate().min_by_key(|(_, c)| shown(c)).map(|(i, _)| i)?;
                    self.candidates.swap_remove(least);
                }
                let (last_ns, heartbeat_ns, boot_ms) = (now_ns, None, None);
                let new = Candidate { who, last_ns, heartbeat_ns, heartbeats: 0, boot_ms, stamped: 0, is_armed: false };
                self.candidates.push(new).ok()?;
                self.candidates.len() - 1
            }
        };
        let pinned_ns = self.pinned.map(|p| p.last_ns);
        let c = self.candidates.get_mut(index)?;
        // While the pinned one speaks nothing is proven.
        if pinned_ns.is_some_and(|at| now_ns.saturating_sub(at) < SILENT_NS) {
            (c.heartbeats, c.stamped, c.heartbeat_ns, c.boot_ms) = (0, 0, None, None);
            return None;
        }
        c.last_ns = now_ns;
        c.is_armed = is_armed(frame).unwrap_or(c.is_armed);
        if is_autopilot(frame) && c.heartbeat_ns.is_none_or(|at| now_ns.saturating_sub(at) >= HEARTBEAT_APART_NS) {
            c.heartbeats = c.heartbeats.saturating_add(1);
            c.heartbeat_ns = Some(now_ns);
        }
        if let Some(ms) = boot_ms(frame) {
            let grows = c.boot_ms.is_none_or(|last| ms >= last);
            c.stamped = if grows { c.stamped.saturating_add(1) } else { 0 };
            c.boot_ms = Some(ms);
        }
        let proven = c.heartbeats >= HEARTBEATS && c.stamped >= STAMPED || c.heartbeats >= HEARTBEATS_ALONE;
        proven.then_some(*c)
    }
}

impl Pinned {
    fn hear(&mut self, frame: &Frame<'_>, now_ns: u64) {
        self.last_ns = now_ns;
        self.boot = boot_ms(frame).map(|ms| (ms, now_ns)).or(self.boot);
        self.is_armed = is_armed(frame).unwrap_or(self.is_armed);
    }

    /// Its boot clock would stand at `ms` now.
    fn goes_on_at(&self, ms: u32, now_ns: u64) -> bool {
        self.boot.is_none_or(|(then_ms, then_ns)| {
            let expected = u64::from(then_ms) + now_ns.saturating_sub(then_ns) / 1_000_000;
            expected.abs_diff(ms.into()) < CLOCK_SLACK_MS
        })
    }

    /// The candidate is at the same host, has the same ids, and goes on where this one stopped, or was just started on the ground.
    fn may_be_replaced_by(&self, candidate: &Candidate, now_ns: u64) -> bool {
        let host = |who: &Identity| who.address.map(|a| a.ip());
        let same = self.who.ids() == candidate.who.ids() && host(&self.who) == host(&candidate.who);
        let clock = match candidate.boot_ms {
            Some(ms) => self.goes_on_at(ms, now_ns) || (!self.is_armed && u64::from(ms) < JUST_STARTED_MS),
            None => self.boot.is_none(),
        };
        same && clock && now_ns.saturating_sub(self.last_ns) >= SILENT_NS
    }
}

/// What a heartbeat says about arming.
fn is_armed(frame: &Frame<'_>) -> Option<bool> {
    frame.message::<HEARTBEAT_DATA>().map(|h| h.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED))
}

fn is_autopilot(frame: &Frame<'_>) -> bool {
    frame.message::<HEARTBEAT_DATA>().is_some_and(|h| h.autopilot != MavAutopilot::MAV_AUTOPILOT_INVALID)
}

/// Milliseconds since boot of the messages every autopilot sends.
fn boot_ms(frame: &Frame<'_>) -> Option<u32> {
    match frame.id() {
        GLOBAL_POSITION_INT_DATA::ID => frame.message::<GLOBAL_POSITION_INT_DATA>().map(|m| m.time_boot_ms),
        ATTITUDE_QUATERNION_DATA::ID => frame.message::<ATTITUDE_QUATERNION_DATA>().map(|m| m.time_boot_ms),
        ATTITUDE_DATA::ID => frame.message::<ATTITUDE_DATA>().map(|m| m.time_boot_ms),
        SYSTEM_TIME_DATA::ID => frame.message::<SYSTEM_TIME_DATA>().map(|m| m.time_boot_ms),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mavlink::{Encoder, Framer};

    const S: u64 = 1_000_000_000;

    fn address(port: u16) -> Option<SocketAddr> {
        Some(SocketAddr::from(([10, 0, 0, 2], port)))
    }

    /// Judges `message` of ids 1, 1.
    fn judge<D: MessageData>(peers: &mut Peers, from: Option<SocketAddr>, message: &D, now_ns: u64) -> Verdict {
        let (mut framer, mut encoder) = (Framer::new(), Encoder::new(1, 1));
        framer.push(encoder.encode(message, None));
        peers.judge(from, &framer.next_frame().expect("a frame"), now_ns)
    }

    fn heartbeat() -> HEARTBEAT_DATA {
        HEARTBEAT_DATA { autopilot: MavAutopilot::MAV_AUTOPILOT_PX4, ..HEARTBEAT_DATA::default() }
    }

    /// A second of an autopilot that was started at time 0.
    fn speak(peers: &mut Peers, port: u16, second: u64) -> Verdict {
        let time_boot_ms = (second * 1000) as u32;
        judge(peers, address(port), &ATTITUDE_DATA { time_boot_ms, ..ATTITUDE_DATA::default() }, second * S);
        judge(peers, address(port), &heartbeat(), second * S)
    }

    #[test]
    fn one_heartbeat_or_a_burst_of_them_proves_nothing() {
        let mut peers = Peers::new(1);
        for _ in 0..100 {
            judge(&mut peers, address(7), &heartbeat(), S);
        }
        assert!(!peers.is_pinned());
    }

    #[test]
    fn once_pinned_nobody_else_is_believed_while_the_autopilot_speaks() {
        let mut peers = Peers::new(1);
        for second in 200..210 {
            // Three heartbeats, and three times after the first one, are its proof.
            let proven = if second < 203 { Verdict::Claims } else { Verdict::Take };
            assert_eq!(speak(&mut peers, 7, second), proven);
        }
        assert_eq!(peers.address(), address(7));
        for second in 210..300 {
            assert_eq!(speak(&mut peers, 8, second), Verdict::Refuse, "the same ids from another address");
            assert_eq!(speak(&mut peers, 7, second), Verdict::Take);
        }
    }

    #[test]
    fn nothing_is_taken_of_a_stranger_who_speaks_before_the_autopilot_has_proven_itself() {
        let mut peers = Peers::new(1);
        for second in 200..206 {
            let strange = GLOBAL_POSITION_INT_DATA { time_boot_ms: 7, ..GLOBAL_POSITION_INT_DATA::default() };
            assert_ne!(judge(&mut peers, address(8), &strange, second * S), Verdict::Take);
            if second % 2 == 0 {
                assert_ne!(judge(&mut peers, address(8), &heartbeat(), second * S), Verdict::Take);
            }
            speak(&mut peers, 7, second);
        }
        assert_eq!(peers.address(), address(7));
        assert_eq!(judge(&mut peers, address(8), &heartbeat(), 206 * S), Verdict::Refuse);
        assert_eq!(speak(&mut peers, 7, 206), Verdict::Take);
    }

    #[test]
    fn while_the_autopilot_is_silent_no_other_host_takes_its_place_and_no_restart_is_believed_in_the_air() {
        let elsewhere = Some(SocketAddr::from(([10, 0, 0, 3], 7)));
        for (armed, from, clock_s, taken) in [
            (true, elsewhere, 0, false),
            (true, address(9), 1010, false),
            (false, address(9), 1010, true),
            (true, address(9), 0, true),
        ] {
            let mut peers = Peers::new(1);
            let mut beat = heartbeat();
            beat.base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, armed);
            let second = |peers: &mut Peers, from, s: u64, clock: u64| {
                let attitude = ATTITUDE_DATA { time_boot_ms: (clock * 1000) as u32, ..ATTITUDE_DATA::default() };
                judge(peers, from, &beat, s * S);
                judge(peers, from, &attitude, s * S)
            };
            for s in 1000..1010 {
                second(&mut peers, address(7), s, s);
            }
            let last = (1010..1030).map(|s| second(&mut peers, from, s, s - clock_s)).last();
            assert_eq!(last, Some(if taken { Verdict::Take } else { Verdict::Refuse }), "{armed} {from:?} {clock_s}");
            // The first one comes back: it is the autopilot again, and what was taken in between is void.
            let back = second(&mut peers, address(7), 1030, 1030);
            assert_eq!(back, if taken { Verdict::TakeAfresh } else { Verdict::Take });
            assert_eq!(peers.address(), address(7));
        }
    }

    #[test]
    fn an_autopilot_that_comes_back_from_another_port_goes_on_and_another_one_does_not() {
        for (clock_s, back) in [(0, true), (5000, false)] {
            let mut peers = Peers::new(1);
            for second in 1000..1010 {
                speak(&mut peers, 7, second);
            }
            let verdicts: std::vec::Vec<Verdict> = (1010..1030)
                .map(|second| {
                    let time_boot_ms = ((second + clock_s) * 1000) as u32;
                    let attitude = ATTITUDE_DATA { time_boot_ms, ..ATTITUDE_DATA::default() };
                    judge(&mut peers, address(9), &attitude, second * S);
                    judge(&mut peers, address(9), &heartbeat(), second * S)
                })
                .collect();
            assert_eq!(verdicts[4], Verdict::Refuse, "the old one has not been silent for long enough");
            assert_eq!(verdicts[19] == Verdict::Take, back);
        }
    }

    #[test]
    fn more_strangers_than_there_is_room_for_keep_nobody_out() {
        let mut peers = Peers::new(1);
        for second in 200..206 {
            for port in 100..140 {
                judge(&mut peers, address(port), &heartbeat(), second * S);
            }
            speak(&mut peers, 7, second);
        }
        // Whoever it is, it is one; and it is not a stranger that only sends heartbeats.
        assert!(peers.address().is_none() || peers.address() == address(7));
        for second in 206..240 {
            speak(&mut peers, 7, second);
        }
        assert_eq!(peers.address(), address(7));
    }

    #[test]
    fn a_line_without_addresses_needs_no_proof() {
        let mut peers = Peers::new(1);
        assert_eq!(judge(&mut peers, None, &heartbeat(), S), Verdict::Take);
    }
}
