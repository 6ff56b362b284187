//! The ground's side of a transfer: look at what is offered, decide what to fetch, fetch it chunk by chunk, verify,
//! resume, and give up on nothing.
//!
//! One round asks every inlet for offers and lets each aircraft's transfer advance for a bounded time, all at once. Whoever waits
//! for a chunk or an answer at its end goes on waiting in the next round, so that neither a slow link, a vanished aircraft nor
//! somebody who never answers holds up the others.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver as Wake, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde::Serialize;

use config::upload::UploadSettings;

use super::UploadError;
use super::admission::{Admission, Refusals};
use super::folder::FolderInlet;
use super::heartbeat::Condition;
use super::offer::{Offer, OfferError, Order};
use super::transport::Inlet;
use lookout::{Lookout, QUIET};
use offered::Offered;
use slot::{Advance, Link, Slot};

mod behind;
mod lookout;
mod offered;
mod slot;

/// Longest wait for everything that is not a chunk: two ways over a link of some seconds.
const ANSWER: Duration = Duration::from_secs(10);
/// How often a round looks whether a transfer has come to its end.
const LOOK_UP: Duration = Duration::from_millis(2);
/// Transfers at work at the same time, and the stack of each one's thread: however many aircraft there are, these are the
/// threads and the memory they take. The others have their turn as these end.
const AT_WORK: usize = 64;
const STACK_BYTES: usize = 512 << 10;

/// What happened so far. Everything not received is in here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ReceiveCounters {
    /// Chunks fetched and verified.
    pub chunks: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Chunks that were already on disk when a transfer began (resumed, or the same content as before).
    pub chunks_reused: u64,
    /// Models completed.
    pub models: u64,
    /// Chunks whose bytes did not have the promised hash.
    pub corrupt: u64,
    /// Failed attempts that were or will be repeated.
    pub retries: u64,
    /// Attempts that the ground's own disk failed.
    pub disk: u64,
    /// Offers of other missions.
    pub foreign: u64,
    /// Offers from aircraft the mission does not know.
    pub unknown: u64,
    /// Offers of models above `max_model_mib`.
    pub oversize: u64,
    /// Offers that could not be read.
    pub damaged: u64,
    /// Offers without the signature of the aircraft in whose name they were made.
    pub forged: u64,
    /// Offers older than what is complete already.
    pub stale: u64,
    /// Models that arrived whole and were no readable models.
    pub models_damaged: u64,
    /// Models that arrived whole and were not what their aircraft should have made.
    pub models_refused: u64,
    /// Offers of what is complete already.
    pub duplicates: u64,
}

/// A model that lies verified on the ground.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received {
    /// Whose.
    pub aircraft: String,
    /// The file.
    pub path: PathBuf,
    /// Whether the aircraft said that no more will follow.
    pub finished: bool,
    /// Bytes.
    pub size: u64,
    /// The aircraft knew which session of the ground it was for, and said so.
    pub bound: bool,
}

/// One aircraft's place: its transfer, here or at work in a thread of its own.
struct Seat {
    id: String,
    place: Place,
    received: Option<Received>,
    /// Chunks here and chunks wanted of what is being fetched; (0, 0) when nothing is.
    progress: (usize, usize),
    is_over: bool,
    is_told: bool,
    /// A last model that it was shown and that is not of this session.
    stale: Option<String>,
    /// What is shown of it has changed since it chose.
    is_to_choose: bool,
    /// It was at work in this round.
    has_worked: bool,
    /// What was known of it when something last changed, and when.
    trace: Trace,
    heard: Option<Instant>,
}

/// What changes when an aircraft gives a sign of life: the newest offer, chunks, models.
type Trace = (Option<Order>, (usize, usize), Option<(u64, bool)>);

/// When an aircraft last gave a sign of life, and what it said of itself.
#[derive(Clone, Copy, Debug, Default)]
pub struct LastHeard {
    /// How long ago; `None` = not in this session.
    pub ago: Option<Duration>,
    /// What its newest heartbeat says; `None` where no network leads here.
    pub condition: Option<Condition>,
}

enum Place {
    Here(Box<Slot>),
    AtWork(JoinHandle<(Box<Slot>, Advance)>),
    /// Only while it is moved.
    Between,
}

impl Seat {
    fn new(slot: Slot) -> Self {
        let id = slot.id.clone();
        let place = Place::Between;
        let mut seat = Self {
            id,
            place,
            received: None,
            progress: (0, 0),
            is_over: false,
            is_told: false,
            stale: None,
            is_to_choose: false,
            has_worked: false,
            trace: Trace::default(),
            heard: None,
        };
        seat.put_back(Box::new(slot));
        seat
    }

    fn put_back(&mut self, slot: Box<Slot>) {
        self.received = slot.received();
        self.progress = slot.progress();
        (self.is_over, self.is_told) = (slot.is_over(), slot.is_told());
        self.place = Place::Here(slot);
    }

    fn wants_work(&self) -> bool {
        matches!(&self.place, Place::Here(slot) if slot.wants_work())
    }

    fn is_at_work(&self) -> bool {
        matches!(self.place, Place::AtWork(_))
    }
}

/// Receives the models of one mission.
pub struct Receiver {
    link: Arc<Link>,
    dir: PathBuf,
    seats: Vec<Seat>,
    /// What is shown.
    offered: Offered,
    lookout: Lookout,
    /// Whose turn it is when not all can be at work at once.
    turn: usize,
    wake: Wake<()>,
    /// Keeps `wake` open when no inlet wakes us.
    _waker: SyncSender<()>,
    /// What happened so far.
    pub counters: ReceiveCounters,
    /// What was not let in, and why.
    pub refusals: Refusals,
}

impl Receiver {
    /// Opens the inlets of the settings and the folder of each aircraft below `dir`.
    ///
    /// # Errors
    /// No inlet configured, an endpoint that cannot be listened on, or a folder that cannot be written.
    pub fn open(settings: &UploadSettings, admission: Admission, dir: &Path) -> Result<Self, UploadError> {
        let (sender, wake) = sync_channel(1);
        let mut inlets: Vec<Box<dyn Inlet>> = Vec::new();
        if let Some(folder) = &settings.folder {
            let Admission { mission, identity, memory, .. } = &admission;
            let most = Offer::max_encoded(settings);
            inlets.push(Box::new(FolderInlet::new(folder, mission, memory.session(), identity, most)));
        }
        #[cfg(feature = "zenoh")]
        if !settings.listen.is_empty() {
            inlets.push(Box::new(super::network::NetworkInlet::open(settings, &admission, sender.clone())?));
        }
        #[cfg(not(feature = "zenoh"))]
        if !settings.listen.is_empty() {
            return Err(UploadError::NoNetwork);
        }
        if inlets.is_empty() {
            return Err(UploadError::NoTransport("listen"));
        }
        Self::with_inlets(settings, admission, dir, inlets, (sender, wake))
    }

    fn with_inlets(
        settings: &UploadSettings,
        admission: Admission,
        dir: &Path,
        inlets: Vec<Box<dyn Inlet>>,
        (waker, wake): (SyncSender<()>, Wake<()>),
    ) -> Result<Self, UploadError> {
        let slot = |id: &String| Seat::new(Slot::open(id, &dir.join(id), settings, &admission));
        let seats = admission.aircraft.iter().map(slot).collect();
        let link = Link { settings: settings.clone(), admission, inlets, stop: AtomicBool::new(false) };
        Ok(Self {
            link: Arc::new(link),
            dir: dir.into(),
            seats,
            offered: Offered::default(),
            lookout: Lookout::default(),
            turn: 0,
            wake,
            _waker: waker,
            counters: ReceiveCounters::default(),
            refusals: Refusals::default(),
        })
    }

    /// The complete models, in the mission's order of aircraft.
    pub fn received(&self) -> Vec<Received> {
        self.seats.iter().filter_map(|s| s.received.clone()).collect()
    }

    /// Whether the last word of every aircraft is here: its last model, or one that may not count.
    pub fn all_finished(&self) -> bool {
        self.over().into_iter().all(|over| over)
    }

    /// Of every aircraft whether its last word is here.
    pub fn over(&self) -> Vec<bool> {
        self.seats.iter().map(|s| !s.is_at_work() && s.is_over).collect()
    }

    /// What of an aircraft is shown in the place of this session's last model, in words.
    pub fn stale(&self) -> Vec<(String, String)> {
        let lacks = |s: &&Seat| s.received.as_ref().is_none_or(|r| !r.finished);
        self.seats.iter().filter(lacks).filter_map(|s| Some((s.id.clone(), s.stale.clone()?))).collect()
    }

    /// Takes the session's number off the media: nothing more is to be bound to it.
    pub fn end_session(&self) {
        self.link.inlets.iter().for_each(|inlet| inlet.end_session());
    }

    /// Whether every aircraft whose model is here has signed for the receipt.
    pub fn all_told(&self) -> bool {
        self.told().into_iter().all(|told| told)
    }

    /// Of every aircraft whether it has signed for the receipt of what is here.
    pub fn told(&self) -> Vec<bool> {
        self.seats.iter().map(|s| !s.is_at_work() && s.is_told).collect()
    }

    /// Per aircraft: chunks here and chunks wanted of what is being fetched now; (0, 0) when nothing is.
    pub fn progress(&self) -> Vec<(String, usize, usize)> {
        self.seats.iter().map(|s| (s.id.clone(), s.progress.0, s.progress.1)).collect()
    }

    /// When each aircraft was last heard, in the order of the mission.
    pub fn last_heard(&self) -> Vec<LastHeard> {
        let last_heard = |seat: &Seat| {
            let heard = self.link.inlets.iter().filter_map(|inlet| inlet.heard(&seat.id)).max_by_key(|heard| heard.at);
            let at = seat.heard.max(heard.map(|heard| heard.at));
            LastHeard { ago: at.map(|at| at.elapsed()), condition: heard.map(|heard| heard.heartbeat.condition) }
        };
        self.seats.iter().map(last_heard).collect()
    }

    /// Notes who has given a sign of life since the last time.
    fn note_who_was_heard(&mut self) {
        for seat in &mut self.seats {
            let newest = self.offered.of(&seat.id).iter().map(|shown| shown.0.order).max();
            let trace = (newest, seat.progress, seat.received.as_ref().map(|r| (r.size, r.finished)));
            // What lay here before the session is no sign.
            let is_first = seat.heard.is_none() && newest.is_none();
            if std::mem::replace(&mut seat.trace, trace) != trace && !is_first {
                seat.heard = Some(Instant::now());
            }
        }
    }

    /// Waits for an announcement, `poll_s` at most.
    pub fn wait(&self) {
        // Woken or not, the next round looks at everything.
        let _ = self.wake.recv_timeout(Duration::from_secs_f64(self.link.settings.poll_s));
    }

    /// Looks for offers once and lets every transfer advance. Returns true when there is more to fetch right away.
    ///
    /// # Errors
    /// None at present: whatever fails, one aircraft's disk included, is counted, said and tried again.
    pub fn round(&mut self, stop: &AtomicBool) -> Result<bool, UploadError> {
        self.begin_look();
        let begun = Instant::now();
        let until = begun + Duration::from_secs_f64(self.link.settings.poll_s);
        // Whoever is at work has his turn now.
        self.seats.iter_mut().for_each(|seat| seat.has_worked = seat.is_at_work());
        loop {
            self.collect();
            self.take_in();
            // What is shown now may be better than what was chosen last.
            let has_looked = !self.lookout.is_waiting() || begun.elapsed() >= QUIET;
            if has_looked {
                self.put_to_work(until);
            }
            if stop.load(Ordering::Relaxed) {
                self.link.stop.store(true, Ordering::Relaxed);
            }
            let is_at_work = self.seats.iter().any(Seat::is_at_work);
            // Those who have had their turn and want another get it in the next round.
            let is_waiting = self.lookout.is_waiting() && !self.seats.iter().any(Seat::wants_work);
            if Instant::now() >= until || (!is_at_work && !is_waiting && self.waiting().next().is_none()) {
                break;
            }
            if self.wake.try_recv().is_ok() {
                self.begin_look();
            }
            std::thread::sleep(LOOK_UP);
        }
        self.note_who_was_heard();
        Ok(self.lookout.is_waiting() || self.seats.iter().any(|s| s.is_at_work() || s.wants_work()))
    }

    /// Those who wait for their turn: each has one in a round.
    fn waiting(&self) -> impl Iterator<Item = usize> {
        self.in_turn().filter(|i| !self.seats[*i].has_worked && self.seats[*i].wants_work())
    }

    /// All seats, beginning with the one whose turn it is.
    fn in_turn(&self) -> impl Iterator<Item = usize> + use<> {
        let (turn, n) = (self.turn, self.seats.len());
        (0..n).map(move |i| (turn + i) % n)
    }

    /// Lets those whose turn it is advance, as many as may be at work at once.
    fn put_to_work(&mut self, until: Instant) {
        let at_work = self.seats.iter().filter(|s| s.is_at_work()).count();
        let waiting: Vec<usize> = self.waiting().collect();
        // Where nobody waits for a turn it goes on beside the next look.
        let until = if waiting.len() + at_work <= AT_WORK { until + QUIET } else { until };
        for i in waiting.into_iter().take(AT_WORK.saturating_sub(at_work)) {
            let seat = &mut self.seats[i];
            let Place::Here(mut slot) = std::mem::replace(&mut seat.place, Place::Between) else { continue };
            seat.has_worked = true;
            let link = self.link.clone();
            let work = move || {
                let advance = slot.advance(&link, until);
                (slot, advance)
            };
            match std::thread::Builder::new().stack_size(STACK_BYTES).spawn(work) {
                Ok(worker) => seat.place = Place::AtWork(worker),
                Err(e) => {
                    // What is on disk is whole at any time: the next round tries again.
                    tracing::debug!("serve: no thread for {}: {e}", seat.id);
                    self.counters.retries += 1;
                    self.reopen(i);
                    break;
                }
            }
            self.turn = (i + 1) % self.seats.len();
        }
    }

    /// Goes on from what is on disk.
    fn reopen(&mut self, i: usize) {
        let Link { settings, admission, .. } = &*self.link;
        let id = self.seats[i].id.clone();
        let slot = Slot::open(&id, &self.dir.join(&id), settings, admission);
        self.seats[i].put_back(Box::new(slot));
    }

    /// Takes back the transfers that have come to the end of their turn.
    fn collect(&mut self) {
        for i in 0..self.seats.len() {
            let seat = &mut self.seats[i];
            if !matches!(&seat.place, Place::AtWork(worker) if worker.is_finished()) {
                continue;
            }
            let Place::AtWork(worker) = std::mem::replace(&mut seat.place, Place::Between) else { continue };
            match worker.join() {
                Ok((slot, advance)) => {
                    seat.put_back(slot);
                    self.counters.add(&advance.counters);
                    self.refusals.absorb(advance.refusals);
                }
                Err(_) => {
                    self.counters.retries += 1;
                    self.reopen(i);
                }
            }
        }
    }

    /// Begins to ask every inlet for offers.
    fn begin_look(&mut self) {
        if let Err(e) = self.lookout.begin(&self.link) {
            tracing::debug!("serve: no thread to look for offers: {e}");
            self.counters.retries += 1;
        }
    }

    /// Takes in what is shown, and lets each aircraft that is not at work choose anew where that has changed.
    fn take_in(&mut self) {
        let Self { link, lookout, offered, seats, counters, refusals, .. } = self;
        for news in lookout.news(link, offered, counters, refusals) {
            let shown: HashSet<&str> = news.offered.aircraft().collect();
            seats.iter_mut().for_each(|s| s.is_to_choose |= news.is_over || shown.contains(s.id.as_str()));
            match news.is_over {
                true => *offered = news.offered,
                false => offered.update(news.offered),
            }
        }
        for seat in seats.iter_mut().filter(|s| s.is_to_choose) {
            if let Place::Here(slot) = &mut seat.place {
                slot.choose(offered.of(&seat.id), &link.admission, counters, refusals);
                seat.stale = slot.stale();
                seat.progress = slot.progress();
                (seat.is_over, seat.is_told) = (slot.is_over(), slot.is_told());
                seat.is_to_choose = false;
            }
        }
    }
}

/// Transfers under way must not outlive us: the next receiver works in the same folders.
impl Drop for Receiver {
    fn drop(&mut self) {
        self.link.stop.store(true, Ordering::Relaxed);
        self.lookout.finish();
        for seat in &mut self.seats {
            if let Place::AtWork(worker) = std::mem::replace(&mut seat.place, Place::Between) {
                // What it fetched is on disk.
                let _ = worker.join();
            }
        }
    }
}

impl ReceiveCounters {
    fn add(&mut self, o: &Self) {
        self.chunks += o.chunks;
        self.bytes += o.bytes;
        self.chunks_reused += o.chunks_reused;
        self.models += o.models;
        self.corrupt += o.corrupt;
        self.retries += o.retries;
        self.disk += o.disk;
        self.models_damaged += o.models_damaged;
        self.models_refused += o.models_refused;
    }

    fn count_refusal(&mut self, e: &OfferError) {
        match e {
            OfferError::ForeignMission(_) => self.foreign += 1,
            OfferError::UnknownAircraft(_) => self.unknown += 1,
            OfferError::Forged { .. } => self.forged += 1,
            OfferError::Oversize { .. } => self.oversize += 1,
            OfferError::Damaged(_) | OfferError::Version(_) => self.damaged += 1,
        }
    }
}

#[cfg(test)]
mod tests;
