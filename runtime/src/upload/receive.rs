//! The ground's side of a transfer: look at what is offered, decide what to fetch, fetch it chunk by chunk, verify,
//! resume, and give up on nothing.
//!
//! One round asks every inlet for offers and then lets each aircraft's transfer advance for a bounded time, all at
//! once, so that neither a slow link nor a vanished aircraft holds up the others.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver as Wake, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use serde::Serialize;

use config::upload::UploadSettings;

use super::UploadError;
use super::folder::FolderInlet;
use super::offer::{Offer, OfferError};
use super::store::StoreError;
use super::transport::Inlet;
use slot::{Slot, Target};

mod slot;

/// Remembered refusals per kind, so that a repeated bad offer is reported once; beyond it everything is only counted.
const MAX_REMEMBERED: usize = 256;

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
    /// Offers of other missions.
    pub foreign: u64,
    /// Offers from aircraft the mission does not know.
    pub unknown: u64,
    /// Offers of models above `max_model_mib`.
    pub oversize: u64,
    /// Offers that could not be read.
    pub damaged: u64,
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
}

/// Receives the models of one mission.
pub struct Receiver {
    settings: UploadSettings,
    mission: String,
    known: Vec<String>,
    inlets: Vec<Box<dyn Inlet>>,
    slots: Vec<Slot>,
    wake: Wake<()>,
    /// Keeps `wake` open when no inlet wakes us.
    _waker: SyncSender<()>,
    reported: HashSet<String>,
    /// What happened so far.
    pub counters: ReceiveCounters,
}

impl Receiver {
    /// Opens the inlets of the settings and the folder of each aircraft below `dir`.
    ///
    /// # Errors
    /// No inlet configured, an endpoint that cannot be listened on, or a folder that cannot be written.
    pub fn open(
        settings: &UploadSettings,
        mission: &str,
        aircraft: &[String],
        dir: &Path,
    ) -> Result<Self, UploadError> {
        let (sender, wake) = sync_channel(1);
        let mut inlets: Vec<Box<dyn Inlet>> = Vec::new();
        if let Some(folder) = &settings.folder {
            inlets.push(Box::new(FolderInlet::new(folder, mission, Offer::max_encoded(settings))));
        }
        #[cfg(feature = "zenoh")]
        if !settings.listen.is_empty() {
            let inlet = super::network::NetworkInlet::open(settings, mission, 2 * aircraft.len(), sender.clone())?;
            inlets.push(Box::new(inlet));
        }
        #[cfg(not(feature = "zenoh"))]
        if !settings.listen.is_empty() {
            return Err(UploadError::NoNetwork);
        }
        if inlets.is_empty() {
            return Err(UploadError::NoTransport("listen"));
        }
        Self::with_inlets(settings, mission, aircraft, dir, inlets, (sender, wake))
    }

    fn with_inlets(
        settings: &UploadSettings,
        mission: &str,
        aircraft: &[String],
        dir: &Path,
        inlets: Vec<Box<dyn Inlet>>,
        (waker, wake): (SyncSender<()>, Wake<()>),
    ) -> Result<Self, UploadError> {
        let slot = |id: &String| Slot::open(id, &dir.join(id), settings);
        let slots = aircraft.iter().map(slot).collect::<Result<Vec<_>, StoreError>>()?;
        Ok(Self {
            settings: settings.clone(),
            mission: mission.into(),
            known: aircraft.into(),
            inlets,
            slots,
            wake,
            _waker: waker,
            reported: HashSet::new(),
            counters: ReceiveCounters::default(),
        })
    }

    /// The complete models, in the mission's order of aircraft.
    pub fn received(&self) -> Vec<Received> {
        let of = |s: &Slot| {
            let offer = s.store.complete()?;
            let path = s.store.model_path();
            Some(Received { aircraft: s.id.clone(), path, finished: offer.finished, size: offer.size })
        };
        self.slots.iter().filter_map(of).collect()
    }

    /// Whether the last model of every aircraft is here.
    pub fn all_finished(&self) -> bool {
        self.slots.iter().all(|s| s.target.is_none() && s.store.complete().is_some_and(|o| o.finished))
    }

    /// Per aircraft: chunks here and chunks wanted of what is being fetched now; (0, 0) when nothing is.
    pub fn progress(&self) -> Vec<(String, usize, usize)> {
        let of = |s: &Slot| match &s.target {
            Some(Target { offer, .. }) => {
                let missing = s.store.missing(offer).len();
                (s.id.clone(), offer.chunks.len().saturating_sub(missing), offer.chunks.len())
            }
            None => (s.id.clone(), 0, 0),
        };
        self.slots.iter().map(of).collect()
    }

    /// Waits for an announcement, `poll_s` at most.
    pub fn wait(&self) {
        // Woken or not, the next round looks at everything.
        let _ = self.wake.recv_timeout(Duration::from_secs_f64(self.settings.poll_s));
    }

    /// Looks for offers once and lets every transfer advance. Returns true when there is more to fetch right away.
    ///
    /// # Errors
    /// Only what cannot be mended by trying again: the ground's own disk.
    pub fn round(&mut self, stop: &AtomicBool) -> Result<bool, UploadError> {
        self.look();
        let until = Instant::now() + Duration::from_secs_f64(self.settings.poll_s);
        let (settings, inlets) = (&self.settings, &self.inlets);
        let outcomes: Vec<_> = std::thread::scope(|scope| {
            let busy = self.slots.iter_mut().filter(|s| s.wants_work());
            let workers: Vec<_> =
                busy.map(|slot| scope.spawn(move || slot.advance(settings, inlets, until, stop))).collect();
            workers.into_iter().map(|w| w.join()).collect()
        });
        let mut disk = None;
        for outcome in outcomes {
            match outcome {
                Ok((counters, error)) => {
                    self.counters.add(&counters);
                    disk = disk.or(error);
                }
                Err(_) => self.counters.retries += 1,
            }
        }
        match disk {
            Some(e) => Err(e.into()),
            None => Ok(self.slots.iter().any(|s| s.target.is_some() && s.wants_work())),
        }
    }

    /// Reads the offers of every inlet and chooses a target for each aircraft.
    fn look(&mut self) {
        let mut seen: Vec<(Offer, usize)> = Vec::new();
        for (index, inlet) in self.inlets.iter().enumerate() {
            match inlet.offers() {
                Ok(offers) => {
                    for bytes in offers {
                        let offer = Offer::decode(&bytes, &self.settings)
                            .and_then(|o| o.check(&self.mission, &self.known).map(|()| o));
                        match offer {
                            Ok(offer) => seen.push((offer, index)),
                            Err(e) => {
                                self.counters.count_refusal(&e);
                                if self.reported.len() < MAX_REMEMBERED && self.reported.insert(e.to_string()) {
                                    tracing::warn!("serve: {e}; ignored");
                                }
                            }
                        }
                    }
                }
                Err(e) => {
                    self.counters.retries += 1;
                    tracing::debug!("serve: {}: {e}", inlet.name());
                }
            }
        }
        for slot in &mut self.slots {
            let id = slot.id.clone();
            slot.choose(seen.iter().filter(|(o, _)| o.aircraft == id), &mut self.counters);
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
    }

    fn count_refusal(&mut self, e: &OfferError) {
        match e {
            OfferError::ForeignMission(_) => self.foreign += 1,
            OfferError::UnknownAircraft(_) => self.unknown += 1,
            OfferError::Oversize { .. } => self.oversize += 1,
            OfferError::Damaged(_) | OfferError::Version(_) => self.damaged += 1,
        }
    }
}

#[cfg(test)]
mod tests;
