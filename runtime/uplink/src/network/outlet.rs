//! The aircraft's end: holds the models on offer and answers for them.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use config::upload::UploadSettings;
use zenoh::handlers::FifoChannel;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Query;
use zenoh::{Session, Wait};

use super::super::Source;
use super::super::offer::{Hash, Offer, OfferedModel};
use super::super::receipt::{Delivery, MAX_ENCODED, Receipt};
use super::super::transport::{Outlet, TransportError};
use super::{LOOK_UP, NOT_HELD, network, open};
use crate::binding;
use crate::heartbeat::Heartbeat;
use crate::keys::Domain;

/// A model under way is let go when nobody has asked for it for so long: longer than the ground ever waits for a chunk.
const KEPT_FOR: Duration = Duration::from_secs(900);

struct Kept {
    model: Arc<OfferedModel>,
    /// When a chunk of it was last asked for.
    asked: Option<Instant>,
}

impl Kept {
    fn is_under_way(&self) -> bool {
        self.asked.is_some_and(|at| at.elapsed() < KEPT_FOR)
    }
}

struct Shared {
    source: Source,
    /// The model on offer, then the one that the ground is in the middle of.
    models: Mutex<VecDeque<Kept>>,
    /// The ground's last word.
    receipt: Mutex<Option<Receipt>>,
    /// The session that the ground asked for last.
    session: Mutex<Option<Hash>>,
    /// When the next chunk may leave, under `max_kib_s`.
    pace: Mutex<Instant>,
    max_kib_s: Option<u32>,
    /// Bytes of offers and chunks that were asked for and handed to the network.
    sent: AtomicU64,
    stop: AtomicBool,
}

impl Shared {
    /// Waits for the bandwidth of so many bytes.
    fn pace(&self, bytes: usize) {
        let Some(kib_s) = self.max_kib_s else { return };
        let free = {
            let mut pace = locked(&self.pace);
            let free = (*pace).max(Instant::now());
            *pace = free + Duration::from_secs_f64(bytes as f64 / (f64::from(kib_s) * 1024.0));
            free
        };
        while let Some(left) = free.checked_duration_since(Instant::now())
            && !left.is_zero()
            && !self.stop.load(Ordering::Relaxed)
        {
            std::thread::sleep(left.min(LOOK_UP));
        }
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every critical section leaves the data whole, so a panic elsewhere does not make it wrong.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The aircraft's end.
pub struct NetworkOutlet {
    session: Session,
    prefix: String,
    endpoints: String,
    shared: Arc<Shared>,
    server: Option<JoinHandle<()>>,
}

impl NetworkOutlet {
    /// Starts connecting to `settings.connect` and answering; returns before a connection exists.
    ///
    /// # Errors
    /// An endpoint or certificate that zenoh cannot use at all.
    pub fn open(settings: &UploadSettings, source: Source) -> Result<Self, TransportError> {
        let session = open(settings, &[], &settings.connect, (&source.aircraft, &source.identity), None)?;
        let prefix = format!("dgtr/{}/{}", source.mission, source.aircraft);
        let queries =
            session.declare_queryable(format!("{prefix}/**")).with(FifoChannel::new(64)).wait().map_err(network)?;
        let shared = Arc::new(Shared {
            source,
            models: Mutex::default(),
            receipt: Mutex::default(),
            session: Mutex::default(),
            pace: Mutex::new(Instant::now()),
            max_kib_s: settings.max_kib_s,
            sent: AtomicU64::new(0),
            stop: AtomicBool::new(false),
        });
        let (state, own) = (shared.clone(), prefix.clone());
        // A thread of our own: reading files or waiting for a slow link must not stall zenoh's.
        let server = std::thread::Builder::new().name("upload-serve".into()).spawn(move || {
            while !state.stop.load(Ordering::Relaxed) {
                match queries.recv_timeout(LOOK_UP) {
                    Ok(Some(query)) => answer(&state, &own, &query),
                    Ok(None) => {}
                    Err(_) => break,
                }
            }
        });
        Ok(Self {
            session,
            prefix,
            endpoints: settings.connect.join(", "),
            shared,
            server: Some(server.map_err(network)?),
        })
    }
}

/// Replies to one query, or leaves it without a reply when it is not for us.
fn answer(shared: &Shared, prefix: &str, query: &Query) {
    let asked = query.key_expr().as_str();
    let Some(rest) = asked.strip_prefix("dgtr/") else { return };
    let Some((_, rest)) = rest.split_once('/') else { return };
    let Some((_, what)) = rest.split_once('/') else { return };
    let session = session_of(shared, asked, query);
    if session.is_some() {
        *locked(&shared.session) = session;
    }
    if what != "receipt" && session.is_none() {
        return;
    }
    let payload = match what.split_once('/') {
        None if what == "offer" => {
            let newest = locked(&shared.models).front().map(|kept| kept.model.clone());
            newest.map(|model| shared.source.bind(&model.offer, session).encode())
        }
        None if what == "receipt" => acknowledge(shared, query),
        Some(("chunk", name)) => match find(shared, name) {
            Some((model, index)) => match model.chunk(index) {
                Ok(bytes) => {
                    shared.pace(bytes.len());
                    Some(bytes)
                }
                Err(e) => {
                    tracing::warn!("upload: model file cannot be read back: {}", disk::told(&e));
                    None
                }
            },
            None => {
                // So that the ground turns to what is on offer now instead of waiting.
                if let Err(e) = query.reply_err(NOT_HELD).wait() {
                    tracing::debug!("upload: reply to {asked} not sent: {e}");
                }
                None
            }
        },
        _ => None,
    };
    if let Some(payload) = payload {
        let bytes = payload.len() as u64;
        match query.reply(format!("{prefix}/{what}"), payload).wait() {
            Ok(()) => _ = shared.sent.fetch_add(bytes, Ordering::Relaxed),
            Err(e) => tracing::debug!("upload: reply to {asked} not sent: {e}"),
        }
    }
}

/// The session that the ground asks for. None unless it signed the question, where anything is signed: others would take the
/// link from it.
fn session_of(shared: &Shared, asked: &str, query: &Query) -> Option<Hash> {
    let payload = query.payload().filter(|p| p.len() as u64 <= binding::MAX_SEALED)?.to_bytes();
    binding::open(&payload, asked, Domain::Request, &shared.source.identity)
}

/// Takes a receipt that is really the ground's, and signs for it.
fn acknowledge(shared: &Shared, query: &Query) -> Option<Vec<u8>> {
    let payload = query.payload().filter(|p| p.len() as u64 <= MAX_ENCODED)?.to_bytes();
    let Source { identity, mission, aircraft, .. } = &shared.source;
    let receipt = Receipt::open(&payload, identity, mission, aircraft).or_else(|| {
        tracing::warn!("upload: a receipt that is not signed by the ground; ignored");
        None
    })?;
    *locked(&shared.receipt) = Some(receipt);
    Some(identity.sign(Domain::Acknowledgement, &payload).map_or(Vec::new(), |s| s.to_vec()))
}

fn find(shared: &Shared, name: &str) -> Option<(Arc<OfferedModel>, usize)> {
    let hash = *blake3::Hash::from_hex(name).ok()?.as_bytes();
    let mut models = locked(&shared.models);
    models.iter_mut().find_map(|kept| {
        let index = kept.model.find(&hash)?;
        kept.asked = Some(Instant::now());
        Some((kept.model.clone(), index))
    })
}

impl Outlet for NetworkOutlet {
    fn name(&self) -> String {
        format!("network {}", self.endpoints)
    }

    fn offer(&mut self, model: &Arc<OfferedModel>) -> Result<(), TransportError> {
        {
            let mut models = locked(&self.shared.models);
            // The last of a flight replaces everything; a checkpoint leaves the one that is being fetched in place.
            models.retain(|kept| kept.is_under_way() && !model.offer.finished);
            models.truncate(1);
            models.push_front(Kept { model: model.clone(), asked: None });
        }
        self.session
            .put(format!("{}/offer", self.prefix), Vec::new())
            .congestion_control(CongestionControl::Drop)
            .wait()
            .map_err(network)
    }

    fn delivery(&mut self, offer: &Offer) -> Delivery {
        let told = locked(&self.shared.receipt).as_ref().and_then(|r| r.bearing(offer));
        let fetching = || locked(&self.shared.models).iter().any(Kept::is_under_way);
        told.unwrap_or_else(|| if fetching() { Delivery::Fetching } else { Delivery::Waiting })
    }

    fn sent(&self) -> u64 {
        self.shared.sent.load(Ordering::Relaxed)
    }

    fn say(&mut self, heartbeat: &Heartbeat) {
        // The session that the mission names is known before the ground asks.
        let asked = *locked(&self.shared.session);
        let Some(session) = self.shared.source.session.or(asked) else { return };
        let key = format!("{}/heartbeat", self.prefix);
        let sealed = heartbeat.seal(&session, &key, &self.shared.source.identity);
        // Before chunks on a slow link, and dropped rather than waited for.
        let put = self.session.put(key, sealed).congestion_control(CongestionControl::Drop);
        if let Err(e) = put.priority(Priority::InteractiveHigh).wait() {
            tracing::debug!("upload: a heartbeat was not sent: {e}");
        }
    }
}

impl Drop for NetworkOutlet {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(server) = self.server.take() {
            // The thread ends within one receive time-out and has nothing to report.
            let _ = server.join();
        }
        if let Err(e) = self.session.close().wait() {
            tracing::debug!("upload: closing the session: {e}");
        }
    }
}
