//! The ground station's job: receive the models of all aircraft of a mission, then merge them.
//!
//! It may be stopped and started again at any time: what has been received stays in `out/received`, what has been
//! merged in `out/global.dgtr`.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use config::error::{Error, ErrorKind};
use config::mission::Mission;
use config::upload::UploadSettings;
use uplink::UploadError;
use uplink::admission::{Admission, ModelRefusal, Refusals};
use uplink::keys::{GROUND, Identity};
use uplink::memory::Memory;
use uplink::receive::{LastHeard, ReceiveCounters, Received, Receiver};

use crate::AggregateError;
use crate::jobs::aggregate::{self, Outcome};
use crate::member::Member;
use redealt::Redealt;

pub mod admit;
mod board;
mod joining;
mod redealt;
mod watchdog;

pub use board::Board;
pub use joining::{Joined, Joining};
pub use redealt::carry;
pub use watchdog::COVERED_PCT;

/// Where received models lie in the folder of a ground.
pub const RECEIVED: &str = "received";
/// The mission that a ground received them for, beside them.
pub const MISSION: &str = "mission.toml";

/// After the last model is here, the aircraft have so long to take their receipts.
const RECEIPTS: Duration = Duration::from_secs(10);

/// Why nothing could be served or merged.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// Receiving.
    #[error(transparent)]
    Upload(#[from] UploadError),
    /// Merging.
    #[error(transparent)]
    Aggregate(#[from] AggregateError),
    /// Stopped or timed out before any model was complete.
    #[error("no model of mission {0:?} has arrived yet; start again to continue receiving")]
    Nothing(String),
}

impl Error for ServeError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Upload(e) => e.kind(),
            Self::Aggregate(e) => e.kind(),
            Self::Nothing(_) => ErrorKind::Interrupted,
        }
    }
}

/// What is told while receiving.
#[derive(Clone, Debug)]
pub struct Progress {
    /// Aircraft whose last model is here.
    pub finished: usize,
    /// All aircraft.
    pub aircraft: usize,
    /// Per aircraft with a transfer under way: name, chunks here, chunks of the model.
    pub transfers: Vec<(String, usize, usize)>,
    /// Bytes received by this run.
    pub bytes: u64,
    /// The complete models.
    pub received: Vec<Received>,
    /// Of every aircraft, in the mission's order, when it was last heard, and what it said of itself.
    pub last_heard: Vec<LastHeard>,
}

/// What came in.
#[derive(Clone, Debug)]
pub struct Reception {
    /// Complete models.
    pub received: Vec<Received>,
    /// Aircraft without a final model.
    pub missing: Vec<String>,
    /// Aircraft whose final model of an earlier session was shown instead, and what it is.
    pub stale: Vec<(String, String)>,
    /// What happened on the way.
    pub counters: ReceiveCounters,
    /// What was not let in, and why.
    pub refusals: Refusals,
    /// Seconds.
    pub seconds: f64,
}

impl Reception {
    /// The aircraft whose model does not say which session of the ground it was made for.
    pub fn unbound(&self) -> impl Iterator<Item = &str> {
        self.received.iter().filter(|r| !r.bound).map(|r| r.aircraft.as_str())
    }
}

/// Receives until the last model of every aircraft is here, `timeout`, or `stop`.
///
/// # Errors
/// No transport configured, an endpoint that cannot be listened on, or the ground's own disk.
pub fn receive(
    mission: &Mission,
    out: &Path,
    timeout: Option<Duration>,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(&Progress),
) -> Result<Reception, UploadError> {
    let start = Instant::now();
    let ids: Vec<String> = mission.aircraft.iter().map(|a| a.id.clone()).collect();
    let folder = out.join(RECEIVED);
    let mut receiver = Receiver::open(&mission.upload, admission(mission, &folder)?, &folder)?;
    let mut redealt = Redealt::new(mission);
    let mut complete: Option<Instant> = None;
    let mut is_over;
    let over = || stop.load(std::sync::atomic::Ordering::Relaxed) || timeout.is_some_and(|t| start.elapsed() >= t);
    loop {
        let more = receiver.round(stop)?;
        let received = redealt.judged(receiver.received());
        redealt.awaited(&received).iter().for_each(|line| tracing::warn!("{line}"));
        // Whoever does not fly any more is here with what it has sent, and hears no receipt.
        let is_last = |id: &String| received.iter().find(|r| r.aircraft == *id).map(|r| r.finished);
        let lost = |id: &String| redealt.is_lost(id) && is_last(id) == Some(true);
        let each = || ids.iter().zip(receiver.over().into_iter().zip(receiver.told()));
        is_over = each().all(|(id, (over, _))| lost(id) || over && is_last(id) != Some(false));
        let is_told = each().all(|(id, (_, told))| lost(id) || told);
        tell(&Progress {
            finished: received.iter().filter(|r| r.finished).count(),
            aircraft: ids.len(),
            transfers: receiver.progress().into_iter().filter(|p| p.2 > 0).collect(),
            bytes: receiver.counters.bytes,
            received,
            last_heard: receiver.last_heard(),
        });
        if is_over {
            let since = complete.get_or_insert_with(Instant::now);
            if is_told || since.elapsed() > RECEIPTS {
                break;
            }
        }
        if over() {
            break;
        }
        if !more {
            receiver.wait();
        }
    }
    if is_over {
        receiver.end_session();
    }
    let received = redealt.judged(receiver.received());
    let is_here = |id: &String| received.iter().any(|r| r.finished && r.aircraft == *id);
    Ok(Reception {
        missing: ids.iter().filter(|id| !is_here(id)).cloned().collect(),
        stale: receiver.stale(),
        counters: receiver.counters,
        refusals: std::mem::take(&mut receiver.refusals),
        seconds: start.elapsed().as_secs_f64(),
        received,
    })
}

/// What the ground of this mission lets in.
fn admission(mission: &Mission, received: &Path) -> Result<Admission, UploadError> {
    let identity = Identity::of(mission, GROUND)?;
    let UploadSettings { keys, again, session, .. } = &mission.upload;
    let (state, word) = (config::state::folder(keys), session.as_deref());
    let memory = match Memory::open(&state, &mission.name, received, word, *again) {
        Ok(memory) => memory,
        Err(e) if identity.is_signed() => return Err(uplink::store::StoreError::from(e).into()),
        Err(e) => {
            tracing::warn!("serve: {e}; models that this session receives are not known to later ones");
            Memory::forgetful(word, *again).map_err(UploadError::Random)?
        }
    };
    let (name, aircraft) = (mission.name.clone(), mission.aircraft.iter().map(|a| a.id.clone()).collect());
    let mission = mission.clone();
    // One model is in memory at a time, however many arrive at once.
    let alone = Mutex::new(());
    let check = Box::new(move |id: &str, path: &Path| {
        // It guards nothing that a panic could leave half done.
        let _alone = alone.lock().unwrap_or_else(PoisonError::into_inner);
        admit::admit(&mission, id, path).map(drop)
    });
    Ok(Admission { mission: name, aircraft, identity, check, memory })
}

/// Merges what has been received, around the mission's origin. A received model that does not count (any more) is left out
/// and returned with its reason, so that one bad file does not cost the others.
///
/// # Errors
/// Nothing that counts has arrived.
pub fn merge(
    mission: &Mission,
    reception: &Reception,
    out: &Path,
    cancelled: &dyn Fn() -> bool,
) -> Result<(Outcome, Vec<(PathBuf, ModelRefusal)>), ServeError> {
    let (mut members, mut left_out) = (Vec::new(), Vec::new());
    for r in &reception.received {
        match admit::admit(mission, &r.aircraft, &r.path) {
            // One at a time in memory.
            Ok(model) => members.push(Member::of(model)),
            Err(why) => left_out.push((r.path.clone(), why)),
        }
    }
    if members.is_empty() {
        return Err(ServeError::Nothing(mission.name.clone()));
    }
    let outcome = aggregate::run(members, &mission.ground, Some(mission.origin), out, cancelled)?;
    Ok((outcome, left_out))
}

#[cfg(test)]
#[cfg(feature = "zenoh")]
#[path = "../../../../tests/ground/fault_table.rs"]
mod fault_table;
#[cfg(test)]
mod tests;
