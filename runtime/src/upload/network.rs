//! The network transport: zenoh over TCP or TLS, never UDP (which lost replies silently when measured).
//!
//! Keys: `dgtr/<mission>/<aircraft>/offer`, `…/chunk/<blake3>`, `…/have/<blake3>`; all three are queries that the
//! aircraft answers, so nothing is kept in between and a restart of either end costs at most one chunk. A new offer
//! is announced by a publication as well, which only wakes the ground early. No scouting, no gossip: both ends
//! talk to the endpoints of the mission file and to nobody else.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use zenoh::handlers::FifoChannel;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, Query};
use zenoh::{Session, Wait};

use config::upload::UploadSettings;

use super::offer::{Hash, Offer, OfferedModel, hex};
use super::transport::{Inlet, Outlet, TransportError};

/// Models an aircraft keeps open: the newest, and older ones the ground may be in the middle of.
const KEPT_MODELS: usize = 3;
/// An older model is let go when nobody has asked for it for so long.
const KEPT_FOR: Duration = Duration::from_secs(120);
/// Longest wait for answers that are not chunks.
const SHORT: Duration = Duration::from_secs(3);

fn network(e: impl std::fmt::Display) -> TransportError {
    TransportError::Network(e.to_string().replace('\n', " "))
}

/// Opens a session of this end only: `listen` for the ground, `connect` for the aircraft.
fn open(settings: &UploadSettings, listen: &[String], connect: &[String]) -> Result<Session, TransportError> {
    let retry = serde_json::json!({
        "period_init_ms": (settings.retry_min_s * 1e3) as u64,
        "period_max_ms": (settings.retry_max_s * 1e3) as u64,
        "period_increase_factor": 2,
    });
    // Twice a chunk: the largest message that can be ours, with room for its envelope.
    let largest = (2 * u64::from(settings.chunk_bytes())).max(Offer::max_encoded(settings) + 4096);
    let mut json = serde_json::json!({
        "mode": "peer",
        "connect": { "endpoints": connect, "timeout_ms": -1, "exit_on_failure": false, "retry": retry },
        "listen": { "endpoints": listen, "timeout_ms": 0, "exit_on_failure": true },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false }, "delay": 0 },
        "transport": { "link": { "rx": { "max_message_size": largest } } },
    });
    if let Some(tls) = &settings.tls {
        json["transport"]["link"]["tls"] = serde_json::json!({
            "root_ca_certificate": tls.authority,
            "enable_mtls": true,
            "listen_certificate": tls.certificate,
            "listen_private_key": tls.key,
            "connect_certificate": tls.certificate,
            "connect_private_key": tls.key,
        });
    }
    let config = zenoh::Config::from_json5(&json.to_string()).map_err(network)?;
    zenoh::open(config).wait().map_err(network)
}

struct Kept {
    model: Arc<OfferedModel>,
    asked: Instant,
}

#[derive(Default)]
struct Shared {
    /// Newest first.
    models: Mutex<VecDeque<Kept>>,
    delivered: Mutex<Option<Hash>>,
    stop: AtomicBool,
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
    pub fn open(settings: &UploadSettings, mission: &str, aircraft: &str) -> Result<Self, TransportError> {
        let session = open(settings, &[], &settings.connect)?;
        let prefix = format!("dgtr/{mission}/{aircraft}");
        let queries =
            session.declare_queryable(format!("{prefix}/**")).with(FifoChannel::new(64)).wait().map_err(network)?;
        let shared = Arc::new(Shared::default());
        let (state, own) = (shared.clone(), prefix.clone());
        // A thread of our own: reading files or waiting for a slow link must not stall zenoh's.
        let server = std::thread::Builder::new().name("upload-serve".into()).spawn(move || {
            while !state.stop.load(Ordering::Relaxed) {
                match queries.recv_timeout(Duration::from_millis(200)) {
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

/// Replies to one query, or leaves it without a reply when we hold nothing that matches.
fn answer(shared: &Shared, prefix: &str, query: &Query) {
    let asked = query.key_expr().as_str();
    let Some(rest) = asked.strip_prefix("dgtr/") else { return };
    let Some((_, rest)) = rest.split_once('/') else { return };
    let Some((_, what)) = rest.split_once('/') else { return };
    let payload = match what.split_once('/') {
        None if what == "offer" => locked(&shared.models).front().map(|k| k.model.offer.encode()),
        Some(("chunk", name)) => find(shared, name).and_then(|(model, index)| match model.chunk(index) {
            Ok(bytes) => Some(bytes),
            Err(e) => {
                tracing::warn!("upload: model file cannot be read back: {e}");
                None
            }
        }),
        Some(("have", name)) => {
            let known = locked(&shared.models).iter().map(|k| k.model.offer.model).find(|m| hex(m) == name);
            if known.is_some() {
                *locked(&shared.delivered) = known;
            }
            known.map(|_| Vec::new())
        }
        _ => None,
    };
    if let Some(payload) = payload
        && let Err(e) = query.reply(format!("{prefix}/{what}"), payload).wait()
    {
        tracing::debug!("upload: reply to {asked} not sent: {e}");
    }
}

fn find(shared: &Shared, name: &str) -> Option<(Arc<OfferedModel>, usize)> {
    let hash = *blake3::Hash::from_hex(name).ok()?.as_bytes();
    let mut models = locked(&shared.models);
    models.iter_mut().find_map(|kept| {
        let index = kept.model.find(&hash)?;
        kept.asked = Instant::now();
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
            models.retain(|kept| kept.asked.elapsed() < KEPT_FOR);
            models.truncate(KEPT_MODELS - 1);
            models.push_front(Kept { model: model.clone(), asked: Instant::now() });
        }
        self.session
            .put(format!("{}/offer", self.prefix), Vec::new())
            .congestion_control(CongestionControl::Drop)
            .wait()
            .map_err(network)
    }

    fn is_delivered(&self, model: &Hash) -> bool {
        *locked(&self.shared.delivered) == Some(*model)
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

/// The ground's end.
pub struct NetworkInlet {
    session: Session,
    mission: String,
    endpoints: String,
    max_offer: u64,
    max_offers: usize,
    chunk_timeout: Duration,
}

impl NetworkInlet {
    /// Listens on `settings.listen`; `wake` gets a token whenever an aircraft announces something.
    ///
    /// # Errors
    /// An endpoint that cannot be listened on (in use, not ours), or unreadable certificates.
    pub fn open(
        settings: &UploadSettings,
        mission: &str,
        max_offers: usize,
        wake: SyncSender<()>,
    ) -> Result<Self, TransportError> {
        let session = open(settings, &settings.listen, &[])?;
        session
            .declare_subscriber(format!("dgtr/{mission}/*/offer"))
            .callback(move |_| {
                // Full means that the ground is about to look anyway.
                let _ = wake.try_send(());
            })
            .background()
            .wait()
            .map_err(network)?;
        Ok(Self {
            session,
            mission: mission.into(),
            endpoints: settings.listen.join(", "),
            max_offer: Offer::max_encoded(settings),
            max_offers,
            chunk_timeout: Duration::from_secs_f64(settings.chunk_timeout_s),
        })
    }

    /// Payloads of the answers to one query, at most `count`, each at most `limit` bytes.
    fn ask(&self, key: &str, timeout: Duration, count: usize, limit: u64) -> Result<Vec<Vec<u8>>, TransportError> {
        let replies = self
            .session
            .get(key)
            .timeout(timeout)
            .congestion_control(CongestionControl::Block)
            .consolidation(ConsolidationMode::None)
            .with(FifoChannel::new(count.max(1)))
            .wait()
            .map_err(network)?;
        let mut payloads = Vec::new();
        while let Ok(reply) = replies.recv() {
            let Ok(sample) = reply.into_result() else { continue };
            let bytes = sample.payload().len() as u64;
            if bytes > limit {
                tracing::debug!("serve: {}", TransportError::TooLong { what: key.into(), bytes, limit });
                // One bad answer must not hide the others; an empty one is counted as damaged.
                payloads.push(Vec::new());
            } else {
                payloads.push(sample.payload().to_bytes().into_owned());
            }
            if payloads.len() == count {
                break;
            }
        }
        Ok(payloads)
    }
}

impl Inlet for NetworkInlet {
    fn name(&self) -> String {
        format!("network {}", self.endpoints)
    }

    fn offers(&self) -> Result<Vec<Vec<u8>>, TransportError> {
        self.ask(&format!("dgtr/{}/*/offer", self.mission), SHORT, self.max_offers, self.max_offer)
    }

    fn chunk(&self, offer: &Offer, index: usize) -> Result<Vec<u8>, TransportError> {
        let hash = offer.chunks[index];
        let key = format!("dgtr/{}/{}/chunk/{}", self.mission, offer.aircraft, hex(&hash));
        let mut payloads = self.ask(&key, self.chunk_timeout, 1, offer.chunk_len(index))?;
        payloads.pop().ok_or(TransportError::NotHeld(hash))
    }

    fn confirm(&self, offer: &Offer) -> Result<(), TransportError> {
        let key = format!("dgtr/{}/{}/have/{}", self.mission, offer.aircraft, hex(&offer.model));
        match self.ask(&key, SHORT, 1, 64)?.is_empty() {
            true => Err(network("the aircraft did not take the receipt")),
            false => Ok(()),
        }
    }
}

impl Drop for NetworkInlet {
    fn drop(&mut self) {
        if let Err(e) = self.session.close().wait() {
            tracing::debug!("upload: closing the session: {e}");
        }
    }
}
