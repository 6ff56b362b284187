//! The ground's end: asks every aircraft, and takes no answer for true that the caller does not accept.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use config::upload::UploadSettings;
use zenoh::handlers::FifoChannel;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Session, Wait};

use super::super::offer::{Hash, Offer, hex};
use super::super::transport::{Inlet, Patience, TransportError};
use super::{LOOK_UP, NOT_HELD, network, open};
use crate::admission::Admission;
use crate::binding;
use crate::heartbeat::{Heard, Heartbeat, MAX_SEALED};
use crate::keys::{Domain, GROUND, Identity};

/// What zenoh lets pass on the ground: from each aircraft, known by its certificate's common name, what lies under its own
/// key; to everybody, what the ground itself asks.
fn access_control(mission: &str, aircraft: &[String], has_certificates: bool) -> serde_json::Value {
    let everything = ["put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"];
    let rule = |id: &str, flow: &str, messages: &[&str], key: String| serde_json::json!({ "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key] });
    let mut rules = vec![rule("ask", "egress", &everything, format!("dgtr/{mission}/**"))];
    let (mut subjects, mut policies) = (Vec::new(), Vec::new());
    if !has_certificates {
        // Who is who is not known; but nobody asks others by way of the ground, and nobody overhears.
        rules.push(rule("answer", "ingress", &["put", "reply", "declare_queryable"], format!("dgtr/{mission}/**")));
        subjects.push(serde_json::json!({ "id": "anybody" }));
        policies.push(serde_json::json!({ "rules": ["ask", "answer"], "subjects": ["anybody"] }));
    }
    for id in aircraft.iter().filter(|_| has_certificates) {
        let own = format!("own {id}");
        let speak = ["put", "reply", "declare_queryable"];
        rules.push(rule(&own, "ingress", &speak, format!("dgtr/{mission}/{id}/**")));
        subjects.push(serde_json::json!({ "id": id, "cert_common_names": [id] }));
        policies.push(serde_json::json!({ "rules": ["ask", own], "subjects": [id] }));
    }
    serde_json::json!({
        "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    })
}

/// The ground's end.
pub struct NetworkInlet {
    session: Session,
    mission: String,
    endpoints: String,
    identity: Identity,
    session_number: Hash,
    max_offer: u64,
    heartbeats: Heartbeats,
}

/// The newest heartbeat of each aircraft.
type Heartbeats = Arc<Mutex<HashMap<String, Heard>>>;

/// Listens to what the aircraft of the mission say of themselves.
fn listen(session: &Session, admission: &Admission) -> Result<Heartbeats, TransportError> {
    let Admission { mission, aircraft, identity, memory, .. } = admission;
    let heartbeats = Heartbeats::default();
    let (heard, ids, identity, number) = (heartbeats.clone(), aircraft.clone(), identity.clone(), *memory.session());
    let prefix = format!("dgtr/{mission}/");
    let hear = move |sample: zenoh::sample::Sample| {
        let key = sample.key_expr().as_str();
        let id = key.strip_prefix(&prefix).and_then(|rest| rest.strip_suffix("/heartbeat"));
        let Some(id) = id.filter(|id| ids.iter().any(|known| known == id)) else { return };
        if sample.payload().len() as u64 > MAX_SEALED {
            return;
        }
        let Some(heartbeat) = Heartbeat::open(&sample.payload().to_bytes(), &number, key, id, &identity) else {
            return;
        };
        // Whatever panicked elsewhere, what is in here is whole.
        let mut heard = heard.lock().unwrap_or_else(PoisonError::into_inner);
        if heard.get(id).is_none_or(|before| before.heartbeat.order < heartbeat.order) {
            heard.insert(id.to_owned(), Heard { at: Instant::now(), heartbeat });
        }
    };
    session
        .declare_subscriber(format!("dgtr/{mission}/*/heartbeat"))
        .callback(hear)
        .background()
        .wait()
        .map_err(network)?;
    Ok(heartbeats)
}

impl NetworkInlet {
    /// Listens on `settings.listen`; `wake` gets a token whenever an aircraft announces something.
    ///
    /// # Errors
    /// An endpoint that cannot be listened on (in use, not ours), or unreadable certificates.
    pub fn open(
        settings: &UploadSettings,
        admission: &Admission,
        wake: SyncSender<()>,
    ) -> Result<Self, TransportError> {
        let Admission { mission, aircraft, identity, .. } = admission;
        if settings.has_tls() && option_env!("TLS_ACCEPT_THROTTLE_TIME").is_none() {
            tracing::warn!(
                "built without .cargo/config.toml: ten strangers a second keep every aircraft out; build in the folder of the sources"
            );
        }
        let session = open(
            settings,
            &settings.listen,
            &[],
            (GROUND, identity),
            Some(access_control(mission, aircraft, settings.has_tls())),
        )?;
        session
            .declare_subscriber(format!("dgtr/{mission}/*/offer"))
            .callback(move |_| {
                // Full means that the ground is about to look anyway.
                let _ = wake.try_send(());
            })
            .background()
            .wait()
            .map_err(network)?;
        let heartbeats = listen(&session, admission)?;
        Ok(Self {
            session,
            heartbeats,
            mission: mission.clone(),
            endpoints: settings.listen.join(", "),
            identity: identity.clone(),
            session_number: *admission.memory.session(),
            max_offer: Offer::max_encoded(settings),
        })
    }

    /// Shows every answer to one query until `take` is content; an answer above `limit` is shown as an empty one. Returns
    /// whether it was, and whether somebody said that the thing is not held.
    fn ask(
        &self,
        key: &str,
        payload: Option<&[u8]>,
        patience: Patience,
        limit: u64,
        take: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<(bool, bool), TransportError> {
        let query = self
            .session
            .get(key)
            // All, not the first: whoever answers first may lie.
            .target(QueryTarget::All)
            .timeout(patience.limit)
            .congestion_control(CongestionControl::Block)
            .consolidation(ConsolidationMode::None)
            .with(FifoChannel::new(4));
        // A receipt is signed itself.
        let question = || binding::seal(&self.session_number, key, Domain::Request, &self.identity);
        let payload = payload.map_or_else(question, <[u8]>::to_vec);
        let replies = query.payload(payload).wait().map_err(network)?;
        let (until, mut not_held) = (Instant::now() + patience.limit, false);
        while Instant::now() < until && !patience.stop.load(Ordering::Relaxed) {
            let reply = match replies.recv_timeout(LOOK_UP) {
                Ok(Some(reply)) => reply,
                Ok(None) => continue,
                Err(_) => break,
            };
            match reply.into_result() {
                Ok(sample) if sample.payload().len() as u64 <= limit => {
                    if take(&sample.payload().to_bytes()) {
                        return Ok((true, not_held));
                    }
                }
                Ok(sample) => {
                    let bytes = sample.payload().len() as u64;
                    tracing::debug!("serve: {}", TransportError::TooLong { what: key.into(), bytes, limit });
                    if take(&[]) {
                        return Ok((true, not_held));
                    }
                }
                Err(e) => not_held |= e.payload().to_bytes() == NOT_HELD,
            }
        }
        Ok((false, not_held))
    }
}

impl Inlet for NetworkInlet {
    fn name(&self) -> String {
        format!("network {}", self.endpoints)
    }

    fn offers(&self, patience: Patience, see: &mut dyn FnMut(&[u8])) -> Result<(), TransportError> {
        let mut see_all = |bytes: &[u8]| {
            see(bytes);
            false
        };
        self.ask(&format!("dgtr/{}/*/offer", self.mission), None, patience, self.max_offer, &mut see_all).map(|_| ())
    }

    fn chunk(
        &self,
        offer: &Offer,
        index: usize,
        patience: Patience,
        accept: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<Vec<u8>, TransportError> {
        let hash = offer.chunks[index];
        let key = format!("dgtr/{}/{}/chunk/{}", self.mission, offer.aircraft, hex(&hash));
        let (mut chunk, mut answers) = (None, 0);
        let (_, not_held) = self.ask(&key, None, patience, offer.chunk_len(index), &mut |bytes| {
            answers += 1;
            let good = accept(bytes);
            chunk = good.then(|| bytes.to_vec());
            good
        })?;
        chunk.ok_or_else(|| match (answers, not_held) {
            (0, true) => TransportError::NotHeld(hash),
            (0, false) => network("no answer in time"),
            _ => TransportError::Corrupt(hash),
        })
    }

    fn deliver_receipt(
        &self,
        aircraft: &str,
        receipt: &[u8],
        patience: Patience,
        accept: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<(), TransportError> {
        let key = format!("dgtr/{}/{aircraft}/receipt", self.mission);
        match self.ask(&key, Some(receipt), patience, 64, accept)?.0 {
            true => Ok(()),
            false => Err(network("the aircraft did not take the receipt")),
        }
    }

    fn heard(&self, aircraft: &str) -> Option<Heard> {
        self.heartbeats.lock().unwrap_or_else(PoisonError::into_inner).get(aircraft).copied()
    }
}

impl Drop for NetworkInlet {
    fn drop(&mut self) {
        if let Err(e) = self.session.close().wait() {
            tracing::debug!("upload: closing the session: {e}");
        }
    }
}
