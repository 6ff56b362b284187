//! The live page: what a job does, for whoever looks at it with a browser.
//!
//! The job writes into a state of fixed size ([`Watch::update`]) where it reports anyway; a thread of its own answers requests and
//! turns the state into text. Nobody who looks holds up the job for longer than that takes: the state is locked meanwhile, never while
//! something is sent.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use config::error::{Error, ErrorKind};
use config::mission::Mission;
use geometry::geodesy::Geodetic;
use job::console;
use serde_json::Value;

use crate::report::ground::{Ground, Ortho};
use crate::report::{Craft, MapRegion, ReportData, ReportError};

mod access;
pub mod request;
mod respond;
mod room;
mod server;

pub use access::Token;
pub use request::{Asked, Refusal, parse};
pub use server::Server;

/// The file in the output folder that says, as GeoJSON, what ground is not covered.
pub const GAPS: &str = "coverage.geojson";
/// Folder of the map within the output folder.
const MAP: &str = "map";

/// Why there is no live page.
#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// Not HOST:PORT.
    #[error("--http {0}: must be ADDRESS:PORT, as 127.0.0.1:8080 or [::1]:8080")]
    Address(String),
    /// Others can reach it, and nobody is asked who they are.
    #[error(
        "--http {0}: lies beyond this machine; give a token (--http-token-file, or token_file in [http]) or listen on 127.0.0.1"
    )]
    Exposed(std::net::SocketAddr),
    /// The file of the token.
    #[error("token file {}: {what}", path.display())]
    Token {
        /// Where.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The port cannot be had.
    #[error("--http {address}: {source}; choose another port, or end what listens there")]
    Listen {
        /// Where.
        address: std::net::SocketAddr,
        /// The system's reason.
        source: std::io::Error,
    },
}

impl Error for HttpError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Address(_) | Self::Exposed(_) | Self::Token { .. } => ErrorKind::Input,
            Self::Listen { source, .. } => Error::kind(source),
        }
    }
}

/// The state of a job, shared between those who write it and those who look at it.
#[derive(Clone, Debug, Default)]
pub struct Watch {
    data: Arc<Mutex<ReportData>>,
    out: PathBuf,
    origin: Option<Geodetic>,
}

impl Watch {
    /// Nothing has happened yet. `out` is the job's output folder, whose map and coverage are shown, too.
    pub fn new(data: ReportData, out: &Path, origin: Geodetic) -> Self {
        Self { data: Arc::new(Mutex::new(data)), out: out.into(), origin: Some(origin) }
    }

    /// Of `mission`, with these of its aircraft `state`; the other regions are shown, too.
    pub fn of(mission: &Mission, aircraft: &[&str], state: &'static str, out: &Path) -> Self {
        let region = |id: &str| mission.aircraft.iter().find(|a| a.id == id).map(|a| mission.region(a));
        let others = mission.aircraft.iter().map(|a| a.id.as_str()).filter(|id| !aircraft.contains(id));
        let map = aircraft.iter().copied().chain(others).map(|id| MapRegion {
            name: id.to_owned(),
            corners: region(id).unwrap_or_default(),
            cameras: Vec::new(),
        });
        let data = ReportData {
            title: format!("Mission {}", mission.name),
            map: map.collect(),
            aircraft: aircraft.iter().map(|id| Craft::new(id, state)).collect(),
            ground: Ground::with_room(mission.keyframes.max as usize * aircraft.len()),
            ..ReportData::default()
        };
        Self::new(data, out, mission.origin)
    }

    fn lock(&self) -> MutexGuard<'_, ReportData> {
        // Every update leaves the state whole, so a panic elsewhere does not make it wrong.
        self.data.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes what has changed. Cheap enough for every step.
    pub fn update(&self, change: impl FnOnce(&mut ReportData)) {
        change(&mut self.lock());
    }

    /// Notes what has changed of aircraft `i`; nothing when there is none.
    pub fn craft(&self, i: usize, change: impl FnOnce(&mut Craft)) {
        if let Some(craft) = self.lock().aircraft.get_mut(i) {
            change(craft);
        }
    }

    /// The state as it is now, for a report: with the log's warnings and the map inside.
    pub fn freeze(&self) -> ReportData {
        let mut data = self.lock().clone();
        data.ground.ortho = Ortho::read(&self.out.join(MAP), self.origin, None);
        data.warnings.extend(console::warnings());
        data
    }

    /// What the live page is told: the state without the ground, and a mark that changes when the ground does.
    fn state(&self, over: bool) -> Result<Value, ReportError> {
        let (mut state, ground, mut warnings) = {
            let data = self.lock();
            let shots = data.ground.shots.len();
            (data.live_json()?, format!("{shots}-{}", data.ground.surveys()), data.warnings.clone())
        };
        warnings.extend(console::warnings());
        state["warnings"] = warnings.into();
        state["ground"] = format!("{ground}-{}", self.drawn()).into();
        state["over"] = over.into();
        Ok(state)
    }

    /// When the map was last drawn, as a number that changes.
    fn drawn(&self) -> u128 {
        let changed = || std::fs::metadata(self.map_file("map.georef.json")).ok()?.modified().ok();
        changed().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok()).map_or(0, |d| d.as_millis())
    }

    /// Pictures and squares as JSON.
    fn ground(&self) -> Vec<u8> {
        let address = format!("map/ortho.png?drawn={}", self.drawn());
        let ortho = Ortho::read(&self.out.join(MAP), self.origin, Some(address));
        let mut data = self.lock();
        data.ground.ortho = ortho;
        // Numbers and texts: there is nothing that JSON could not hold.
        serde_json::to_vec(&data.ground).unwrap_or_default()
    }

    fn map_file(&self, name: &str) -> PathBuf {
        self.out.join(MAP).join(name)
    }

    fn out_file(&self, name: &str) -> PathBuf {
        self.out.join(name)
    }
}
