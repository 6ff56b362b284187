//! One aircraft's transfer: what to fetch, where from, and what to do after a setback.

use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use config::upload::UploadSettings;

use super::{MAX_REMEMBERED, ReceiveCounters};
use crate::upload::offer::{Hash, Offer};
use crate::upload::store::{Store, StoreError};
use crate::upload::transport::{Inlet, TransportError};

/// What is being fetched.
#[derive(Clone)]
pub(super) struct Target {
    pub(super) offer: Offer,
    /// The inlets that offer it.
    pub(super) from: Vec<usize>,
    /// Chunks found on disk have been counted.
    pub(super) counted: bool,
}

pub(super) struct Slot {
    pub(super) id: String,
    pub(super) store: Store,
    pub(super) target: Option<Target>,
    /// Failures in a row.
    failures: u32,
    /// Which of `Target::from` to use; moves on with every failure, as the stick may have what the radio cannot bring.
    source: usize,
    not_before: Instant,
    /// Models whose offer turned out to be a lie.
    refused: HashSet<Hash>,
    /// Sequence of the offer whose receipt the aircraft has taken.
    confirmed: Option<u64>,
}

impl Slot {
    pub(super) fn open(id: &str, dir: &std::path::Path, settings: &UploadSettings) -> Result<Self, StoreError> {
        Ok(Self {
            id: id.into(),
            store: Store::open(dir, settings)?,
            target: None,
            failures: 0,
            source: 0,
            not_before: Instant::now(),
            refused: HashSet::new(),
            confirmed: None,
        })
    }

    pub(super) fn wants_work(&self) -> bool {
        self.target.is_some() && Instant::now() >= self.not_before
    }

    /// Newest offer wins; but a transfer under way is finished first unless the newer one is the last of the flight:
    /// over a slow link, chasing every checkpoint would never complete one.
    pub(super) fn choose<'a>(
        &mut self,
        offers: impl Iterator<Item = &'a (Offer, usize)> + Clone,
        counters: &mut ReceiveCounters,
    ) {
        let usable = offers.clone().filter(|(o, _)| !self.refused.contains(&o.model));
        let Some((best, _)) = usable.max_by_key(|(o, _)| o.sequence) else { return };
        if let Some(done) = self.store.complete() {
            let same = done.model == best.model;
            if same {
                counters.duplicates += 1;
            }
            if done.sequence > best.sequence || (same && self.confirmed == Some(best.sequence)) {
                return;
            }
        }
        let from: Vec<usize> = offers.clone().filter(|(o, _)| o.model == best.model).map(|&(_, i)| i).collect();
        match &mut self.target {
            Some(now) if now.offer.model == best.model => {
                now.offer = best.clone();
                now.from = from;
            }
            Some(_) if !best.finished && self.failures == 0 => {}
            _ => {
                self.store.keep_only(Some(best));
                self.target = Some(Target { offer: best.clone(), from, counted: false });
                self.failures = 0;
                self.not_before = Instant::now();
            }
        }
    }

    /// Fetches until done, `until`, a failure, or `stop`.
    pub(super) fn advance(
        &mut self,
        settings: &UploadSettings,
        inlets: &[Box<dyn Inlet>],
        until: Instant,
        stop: &AtomicBool,
    ) -> (ReceiveCounters, Option<StoreError>) {
        let mut counters = ReceiveCounters::default();
        match self.transfer(&mut counters, inlets, until, stop) {
            Ok(()) => (counters, None),
            Err(Setback::Disk(e)) => (counters, Some(e)),
            Err(Setback::Again(why)) => {
                counters.retries += 1;
                let pause = settings.retry_min_s * f64::from(2u32.saturating_pow(self.failures.min(16)));
                let pause = pause.min(settings.retry_max_s);
                self.not_before = Instant::now() + Duration::from_secs_f64(pause);
                self.failures = self.failures.saturating_add(1);
                self.source = self.source.wrapping_add(1);
                tracing::debug!("serve: {}: {why}; next attempt in {pause:.1} s", self.id);
                (counters, None)
            }
        }
    }

    fn transfer(
        &mut self,
        counters: &mut ReceiveCounters,
        inlets: &[Box<dyn Inlet>],
        until: Instant,
        stop: &AtomicBool,
    ) -> Result<(), Setback> {
        let Some(target) = &mut self.target else { return Ok(()) };
        let (offer, from) = (target.offer.clone(), target.from.clone());
        if self.store.complete().is_some_and(|done| done.model == offer.model) {
            self.store.note(&offer)?;
            return self.finish(&offer, &from, inlets);
        }
        let missing = self.store.missing(&offer);
        if !std::mem::replace(&mut target.counted, true) {
            counters.chunks_reused += (offer.chunks.len() - missing.len()) as u64;
        }
        for index in missing {
            if stop.load(Ordering::Relaxed) || Instant::now() >= until {
                return Ok(());
            }
            let inlet = from.get(self.source % from.len().max(1)).and_then(|&i| inlets.get(i));
            let inlet = inlet.ok_or_else(|| Setback::Again("offered nowhere any more".into()))?;
            let bytes = inlet.chunk(&offer, index)?;
            if let Err(e) = self.store.put(&offer, index, &bytes) {
                counters.corrupt += u64::from(matches!(e, StoreError::Corrupt { .. }));
                return Err(e.into());
            }
            counters.chunks += 1;
            counters.bytes += bytes.len() as u64;
            self.failures = 0;
        }
        if let Err(e) = self.store.assemble(&offer) {
            counters.corrupt += u64::from(!matches!(e, StoreError::Io { .. }));
            if matches!(e, StoreError::WrongWhole(_)) {
                tracing::warn!("serve: {e}");
                if self.refused.len() < MAX_REMEMBERED {
                    self.refused.insert(offer.model);
                }
                self.target = None;
            }
            return Err(e.into());
        }
        counters.models += 1;
        let kind = if offer.finished { "final model" } else { "checkpoint" };
        tracing::info!("serve: received {}'s {kind}, {:.1} MiB", self.id, offer.size as f64 / f64::from(1 << 20));
        self.finish(&offer, &from, inlets)
    }

    /// Tells the aircraft. A receipt that is lost is sent again when the same offer is seen next.
    fn finish(&mut self, offer: &Offer, from: &[usize], inlets: &[Box<dyn Inlet>]) -> Result<(), Setback> {
        self.target = None;
        self.failures = 0;
        for inlet in from.iter().filter_map(|&i| inlets.get(i)) {
            inlet.confirm(offer)?;
        }
        self.confirmed = Some(offer.sequence);
        Ok(())
    }
}

/// Why a transfer did not get further this time.
enum Setback {
    /// Worth another attempt.
    Again(String),
    /// The ground's own disk: trying again will not help.
    Disk(StoreError),
}

impl From<TransportError> for Setback {
    fn from(e: TransportError) -> Self {
        Self::Again(e.to_string())
    }
}

impl From<StoreError> for Setback {
    fn from(e: StoreError) -> Self {
        match e {
            StoreError::Io { .. } => Self::Disk(e),
            other => Self::Again(other.to_string()),
        }
    }
}
