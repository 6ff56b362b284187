//! One aircraft's transfer: what to fetch, where from, and what to do after a setback.

use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use config::upload::UploadSettings;
use disk::Disk;

use super::behind::Behind;
use super::offered::Shown;
use super::{ANSWER, ReceiveCounters, Received};
use crate::admission::{Admission, ModelRefusal, Refusals};
use crate::keys::{Domain, SignatureBytes};
use crate::memory::Stale;
use crate::offer::{Hash, Offer};
use crate::receipt::{Receipt, Verdict};
use crate::store::{Store, StoreError};
use crate::transport::{Inlet, Patience, TransportError};

/// Remembered refusals of one aircraft.
const MAX_REMEMBERED: usize = 256;
/// On a slow link the wait for a chunk grows up to so many times `chunk_timeout_s`.
const MOST_PATIENT: u32 = 32;

/// What every transfer of a mission shares.
pub(super) struct Link {
    pub(super) settings: UploadSettings,
    pub(super) admission: Admission,
    pub(super) inlets: Vec<Box<dyn Inlet>>,
    pub(super) stop: AtomicBool,
}

/// What came of one turn.
#[derive(Default)]
pub(super) struct Advance {
    pub(super) counters: ReceiveCounters,
    pub(super) refusals: Refusals,
}

/// What is being fetched.
#[derive(Clone)]
struct Target {
    offer: Offer,
    /// The inlets that offer it.
    from: Vec<usize>,
    /// Chunks found on disk have been counted.
    counted: bool,
    /// Nobody holds it any more.
    gone: bool,
    /// Bytes of it that lie there to be looked at.
    previewed: u64,
}

pub(super) struct Slot {
    pub(super) id: String,
    store: Store,
    target: Option<Target>,
    /// What is older than what is here: whoever made it should know.
    behind: Behind,
    /// A last model that is shown and is not of this session, in words.
    stale: Option<String>,
    /// Failures in a row.
    failures: u32,
    /// Which of `Target::from` to use; moves on with every failure, as the stick may have what the radio cannot bring.
    source: usize,
    not_before: Instant,
    /// How long to wait for a chunk; follows the link.
    chunk_timeout: Duration,
    /// Offers that turned out to be a lie, or whose model may not count.
    refused_offers: HashSet<Hash>,
    /// Models that may not count.
    refused_models: HashSet<Hash>,
    /// The last model of the flight was one of them.
    last_word_refused: bool,
    /// The offer whose receipt the aircraft has taken.
    confirmed: Option<Hash>,
}

impl Slot {
    pub(super) fn open(id: &str, dir: &std::path::Path, settings: &UploadSettings, admission: &Admission) -> Self {
        Self {
            id: id.into(),
            store: Store::open(&Disk::default(), dir, settings, admission),
            target: None,
            behind: Behind::new(Duration::from_secs_f64(settings.retry_max_s)),
            stale: None,
            failures: 0,
            source: 0,
            not_before: Instant::now(),
            chunk_timeout: Duration::from_secs_f64(settings.chunk_timeout_s),
            refused_offers: HashSet::new(),
            refused_models: HashSet::new(),
            last_word_refused: false,
            confirmed: None,
        }
    }

    pub(super) fn received(&self) -> Option<Received> {
        let offer = self.store.complete()?;
        let path = self.store.model_path();
        let bound = offer.session.is_some();
        Some(Received { aircraft: self.id.clone(), path, finished: offer.finished, size: offer.size, bound })
    }

    pub(super) fn progress(&self) -> (usize, usize) {
        let of = |t: &Target| {
            let all = t.offer.chunks.len();
            (all.saturating_sub(self.store.missing(&t.offer).len()), all)
        };
        self.target.as_ref().map_or((0, 0), of)
    }

    /// Nothing more will come in this flight.
    pub(super) fn is_over(&self) -> bool {
        self.target.is_none() && (self.last_word_refused || self.store.complete().is_some_and(|o| o.finished))
    }

    /// The aircraft has signed for the receipt of what is here.
    pub(super) fn is_told(&self) -> bool {
        self.last_word_refused || self.store.complete().is_none_or(|o| self.confirmed == Some(o.digest()))
    }

    pub(super) fn stale(&self) -> Option<String> {
        self.stale.clone()
    }

    pub(super) fn wants_work(&self) -> bool {
        (self.target.is_some() || self.behind.is_shown()) && Instant::now() >= self.not_before
    }

    /// Newest offer wins; but a transfer under way is finished first unless the newer one is the last of the flight or
    /// nobody holds the older one any more: over a slow link, chasing every checkpoint would never complete one.
    pub(super) fn choose(
        &mut self,
        offers: &[Shown],
        admission: &Admission,
        counters: &mut ReceiveCounters,
        refusals: &mut Refusals,
    ) {
        let key = admission.identity.key_of(&self.id);
        let (stale, offers): (Vec<_>, Vec<_>) =
            offers.iter().partition(|(o, _)| admission.memory.is_stale(o, &key).is_some());
        counters.stale += stale.len() as u64;
        for (offer, inlet) in &stale {
            let Some(stale) = admission.memory.is_stale(offer, &key) else { continue };
            let kind = if offer.finished { "final model" } else { "checkpoint" };
            let why = match stale {
                Stale::Received(order) => format!("an earlier one has received flight {} of it", order.flight),
                Stale::OtherSession => "it was made for another one".into(),
                Stale::NoSession => "it was made for none, and the mission names one".into(),
            };
            let why = format!(
                "{}'s {kind} of flight {} is not of this session: {why}; clear the stick, or give --again to take it all the same",
                self.id, offer.order.flight
            );
            self.stale = offer.finished.then(|| why.clone()).or(self.stale.take());
            refusals.count(why);
            if let Stale::Received(order) = stale {
                // Its numbers may have fallen behind; then it should know.
                let mut known = Offer::clone(offer);
                known.order = order;
                self.behind.show(offer, std::iter::once(*inlet), Some(known));
            }
        }
        let offers = offers.into_iter();
        let usable = offers.clone().filter(|(o, _)| !self.refused_offers.contains(&o.digest()));
        let Some((best, _)) = usable.max_by_key(|(o, _)| o.order) else { return };
        if let Some(done) = self.store.complete() {
            let older = |o: &Offer| o.order < done.order || (o.order == done.order && o.model != done.model);
            counters.stale += offers.clone().filter(|(o, _)| older(o)).count() as u64;
            if older(best) {
                self.behind.show(best, offers.filter(|(o, _)| o.order == best.order).map(|&(_, i)| i), None);
                return;
            }
            if done.model == best.model {
                counters.duplicates += 1;
                if done.order == best.order && self.confirmed == Some(best.digest()) {
                    return;
                }
            }
        }
        let from: Vec<usize> = offers.clone().filter(|(o, _)| o.model == best.model).map(|&(_, i)| i).collect();
        let overtakes = |now: &Target| now.gone || (best.finished && best.order > now.offer.order);
        match &mut self.target {
            Some(now) if now.offer.model == best.model => {
                now.offer = Offer::clone(best);
                now.from = from;
            }
            Some(now) if !overtakes(now) => {
                // Another way to the same may have appeared.
                let also = offers.clone().filter(|(o, i)| o.model == now.offer.model && !now.from.contains(i));
                now.from.extend(also.map(|&(_, i)| i).collect::<Vec<_>>());
            }
            _ => {
                self.store.keep_only(Some(best));
                self.target =
                    Some(Target { offer: Offer::clone(best), from, counted: false, gone: false, previewed: 0 });
                self.failures = 0;
                self.not_before = Instant::now();
                self.last_word_refused = false;
            }
        }
    }

    /// Fetches until done, `until`, a failure, or a request to stop.
    pub(super) fn advance(&mut self, link: &Link, until: Instant) -> Advance {
        let mut done = Advance::default();
        match self.transfer(&mut done, link, until) {
            Ok(()) => {}
            Err(setback) => {
                let why = match setback {
                    Setback::Again(why) => why,
                    // Room may be made, and the others may have some: never the end of the reception.
                    Setback::Disk(e) => {
                        done.counters.disk += 1;
                        if self.failures == 0 {
                            tracing::warn!("serve: {}: {e}; will try again", self.id);
                        }
                        e.to_string()
                    }
                };
                done.counters.retries += 1;
                let settings = &link.settings;
                let pause = settings.retry_min_s * f64::from(2u32.saturating_pow(self.failures.min(16)));
                let pause = pause.min(settings.retry_max_s);
                self.not_before = Instant::now() + Duration::from_secs_f64(pause);
                self.failures = self.failures.saturating_add(1);
                self.source = self.source.wrapping_add(1);
                tracing::debug!("serve: {}: {why}; next attempt in {pause:.1} s", self.id);
            }
        }
        // After its transfer, to which this turn belongs.
        let deliver = |newest: &Offer, from: &[usize]| deliver_receipt(&self.id, newest, Verdict::Received, from, link);
        if let Err(setback) = self.behind.tell(self.store.complete(), deliver) {
            done.counters.retries += 1;
            tracing::debug!("serve: {}: {setback}; will be told again that its numbers fell behind", self.id);
        }
        if let Some(target) = &mut self.target {
            match self.store.preview(&target.offer, target.previewed) {
                Ok(bytes) => target.previewed = bytes,
                // Nothing depends on it.
                Err(e) => tracing::debug!("serve: {}: no preview: {e}", self.id),
            }
        }
        done
    }

    fn transfer(&mut self, done: &mut Advance, link: &Link, until: Instant) -> Result<(), Setback> {
        let Some(target) = &mut self.target else { return Ok(()) };
        let (offer, from) = (target.offer.clone(), target.from.clone());
        if self.refused_models.contains(&offer.model) {
            return self.refuse(&offer, "refused before".into(), &from, link);
        }
        if self.store.complete().is_some_and(|complete| complete.model == offer.model) {
            self.store.note(&offer)?;
            return self.finish(&offer, &from, link);
        }
        let missing = self.store.missing(&offer);
        if !std::mem::replace(&mut target.counted, true) {
            done.counters.chunks_reused += (offer.chunks.len() - missing.len()) as u64;
        }
        for index in missing {
            if link.stop.load(Ordering::Relaxed) || Instant::now() >= until {
                return Ok(());
            }
            let inlet = from.get(self.source % from.len().max(1)).and_then(|&i| link.inlets.get(i));
            let inlet = inlet.ok_or_else(|| Setback::Again("offered nowhere any more".into()))?;
            let bytes = self.fetch(&offer, index, inlet.as_ref(), done, link)?;
            self.store.put(&offer, index, &bytes)?;
            done.counters.chunks += 1;
            done.counters.bytes += bytes.len() as u64;
            self.failures = 0;
        }
        match self.store.assemble(&offer, &link.admission) {
            Ok(()) => {}
            Err(StoreError::Refused { aircraft, why }) => {
                match why {
                    ModelRefusal::Parse(_) => done.counters.models_damaged += 1,
                    ModelRefusal::Meaning(_) => done.counters.models_refused += 1,
                }
                done.refusals.count(format!("{aircraft}'s model: {why}"));
                return self.refuse(&offer, why.to_string(), &from, link);
            }
            Err(e) => {
                done.counters.corrupt += u64::from(!matches!(e, StoreError::Disk(_)));
                if matches!(e, StoreError::WrongWhole(_)) {
                    done.refusals.count(e.to_string());
                    remember(&mut self.refused_offers, offer.digest());
                    self.target = None;
                }
                return Err(e.into());
            }
        }
        done.counters.models += 1;
        let kind = if offer.finished { "final model" } else { "checkpoint" };
        tracing::info!("serve: received {}'s {kind}, {:.1} MiB", self.id, offer.size as f64 / f64::from(1 << 20));
        self.finish(&offer, &from, link)
    }

    /// One chunk with the promised hash, whoever else answers with what.
    fn fetch(
        &mut self,
        offer: &Offer,
        index: usize,
        inlet: &dyn Inlet,
        done: &mut Advance,
        link: &Link,
    ) -> Result<Vec<u8>, Setback> {
        let asked = Instant::now();
        let patience = Patience { limit: self.chunk_timeout, stop: &link.stop };
        let fetched = inlet.chunk(offer, index, patience, &mut |bytes| {
            let right =
                bytes.len() as u64 == offer.chunk_len(index) && blake3::hash(bytes).as_bytes() == &offer.chunks[index];
            done.counters.corrupt += u64::from(!right);
            right
        });
        let base = Duration::from_secs_f64(link.settings.chunk_timeout_s);
        match &fetched {
            Ok(_) => self.chunk_timeout = self.chunk_timeout.min((asked.elapsed() * 4).max(base)),
            Err(TransportError::NotHeld(_)) => {
                if let Some(target) = &mut self.target {
                    target.gone = true;
                }
            }
            Err(TransportError::Network(_)) => {
                self.chunk_timeout = (self.chunk_timeout * 2).min(base * MOST_PATIENT);
            }
            Err(_) => {}
        }
        Ok(fetched?)
    }

    fn refuse(&mut self, offer: &Offer, why: String, from: &[usize], link: &Link) -> Result<(), Setback> {
        self.target = None;
        self.failures = 0;
        remember(&mut self.refused_offers, offer.digest());
        remember(&mut self.refused_models, offer.model);
        self.last_word_refused = offer.finished;
        deliver_receipt(&self.id, offer, Verdict::Refused(why), from, link)
    }

    /// Tells the aircraft. A receipt that is lost is sent again when the same offer is seen next.
    fn finish(&mut self, offer: &Offer, from: &[usize], link: &Link) -> Result<(), Setback> {
        self.target = None;
        self.failures = 0;
        let Admission { identity, memory, .. } = &link.admission;
        memory.note(offer, &identity.key_of(&self.id)).map_err(StoreError::from)?;
        deliver_receipt(&self.id, offer, Verdict::Received, from, link)?;
        self.confirmed = Some(offer.digest());
        Ok(())
    }
}

/// Tells the aircraft `id`, wherever it shows the offer.
fn deliver_receipt(id: &str, offer: &Offer, verdict: Verdict, from: &[usize], link: &Link) -> Result<(), Setback> {
    let identity = &link.admission.identity;
    let receipt = Receipt::new(offer, verdict).seal(identity);
    // Signed for, because anybody may answer.
    let mut accept = |answer: &[u8]| {
        let signature = SignatureBytes::try_from(answer).ok();
        identity.verify(id, Domain::Acknowledgement, &receipt, signature.as_ref()).is_ok()
    };
    for inlet in from.iter().filter_map(|&i| link.inlets.get(i)) {
        inlet.deliver_receipt(id, &receipt, Patience { limit: ANSWER, stop: &link.stop }, &mut accept)?;
    }
    Ok(())
}

fn remember(set: &mut HashSet<Hash>, hash: Hash) {
    if set.len() < MAX_REMEMBERED {
        set.insert(hash);
    }
}

/// Why a transfer did not get further this time.
#[derive(Debug, thiserror::Error)]
enum Setback {
    /// Worth another attempt.
    #[error("{0}")]
    Again(String),
    /// The ground's own disk: as the others, and said.
    #[error(transparent)]
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
            StoreError::Disk(_) => Self::Disk(e),
            other => Self::Again(other.to_string()),
        }
    }
}
