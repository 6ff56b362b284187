//! The network transport: zenoh over TCP or TLS, never UDP (which lost replies silently when measured).
//!
//! Keys: `dgtr/<mission>/<aircraft>/offer`, `…/chunk/<blake3>`, `…/receipt`; all three are queries that the aircraft
//! answers, so nothing is kept in between and a restart of either end costs at most one chunk. A new offer is announced
//! by a publication as well, which only wakes the ground early; `…/heartbeat` is a publication that says how the aircraft is. No scouting, no gossip: both ends talk to the endpoints
//! of the mission file and to nobody else. The ground passes on nothing between those who connect to it, and
//! over TLS an aircraft speaks only under the id that is its certificate's common name (zenoh's access control). What the
//! ground asks is signed, so that an aircraft answers nobody else.

mod certificates;
mod inlet;
mod outlet;

pub use inlet::NetworkInlet;
pub use outlet::NetworkOutlet;

use std::time::Duration;

use zenoh::{Session, Wait};

use config::upload::{CHUNK_KIB, UploadSettings};

use super::keys::Identity;
use super::offer::Offer;
use super::transport::TransportError;

/// Longest time for a connection to come about, milliseconds.
const HANDSHAKE_MS: u64 = 60_000;
/// A connection that has not said who it is by then is ended, milliseconds; so many may be about it at the same time, as many as one host
/// has ports, and no more than leave descriptors for everything else. Of those that have said so fewer are more than a mission has aircraft.
const ACCEPT_MS: u64 = 15_000;
const PENDING: u64 = 1 << 16;
const OTHER_DESCRIPTORS: u64 = 256;
const SESSIONS: u64 = 4096;
/// How often a waiting thread looks whether it should stop.
const LOOK_UP: Duration = Duration::from_millis(100);
/// What the aircraft answers for a chunk it does not have.
const NOT_HELD: &[u8] = b"not held";

fn network(e: impl std::fmt::Display) -> TransportError {
    TransportError::Network(e.to_string().replace('\n', " "))
}

/// How many connections may be about saying who they are.
fn pending() -> u64 {
    let open = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
    open.map_or(PENDING, |open| open.saturating_sub(OTHER_DESCRIPTORS).clamp(OTHER_DESCRIPTORS, PENDING))
}

/// Opens a session of this end only: `listen` for the ground, `connect` for the aircraft. `access` says who may say what.
fn open(
    settings: &UploadSettings,
    listen: &[String],
    connect: &[String],
    (id, identity): (&str, &Identity),
    access: Option<serde_json::Value>,
) -> Result<Session, TransportError> {
    let retry = serde_json::json!({
        "period_init_ms": (settings.retry_min_s * 1e3) as u64,
        "period_max_ms": (settings.retry_max_s * 1e3) as u64,
        "period_increase_factor": 2,
    });
    // Twice the largest chunk of any sender: the largest message that can be ours, with room for its envelope.
    let largest = (2048 * u64::from(*CHUNK_KIB.end())).max(Offer::max_encoded(settings) + 4096);
    let mut json = serde_json::json!({
        "mode": "peer",
        "connect": { "endpoints": connect, "timeout_ms": -1, "exit_on_failure": false, "retry": retry },
        "listen": { "endpoints": listen, "timeout_ms": 0, "exit_on_failure": true },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false }, "delay": 0 },
        "transport": {
            // A handshake over a link with a delay of seconds.
            "unicast": {
                "open_timeout": HANDSHAKE_MS, "accept_timeout": ACCEPT_MS, "accept_pending": pending(), "max_sessions": SESSIONS,
            },
            "link": { "rx": { "max_message_size": largest } },
        },
    });
    let tls = match &settings.tls {
        Some(own) => Some(certificates::of_files(own)?),
        None if settings.has_tls() => certificates::settings(identity, id)?,
        None => None,
    };
    if let Some(tls) = tls {
        json["transport"]["link"]["tls"] = tls;
    }
    if let Some(access) = access {
        json["access_control"] = access;
    }
    let config = zenoh::Config::from_json5(&json.to_string()).map_err(network)?;
    zenoh::open(config).wait().map_err(network)
}

/// A stranger that answers every question about `keys` with `answer`, as fast as it can.
#[cfg(test)]
pub(super) fn open_client(settings: &UploadSettings, keys: &str, answer: Vec<u8>) -> Session {
    let session = open(settings, &[], &settings.connect, ("a1", &Identity::unsigned()), None).expect("session");
    session
        .declare_queryable(keys.to_owned())
        .callback(move |query| {
            let asked = query.key_expr().as_str().replace('*', "a1");
            let _ = query.reply(asked, answer.clone()).wait();
        })
        .background()
        .wait()
        .expect("queryable");
    session
}

#[cfg(test)]
mod tests;
