//! The aircraft's side: keeps the newest model on offer, in the background.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use config::upload::{Encoding, UploadSettings};
use models::formats::{FormatError, delivery::Rounding, model};
use models::ground_cell::{CellKey, Grid};

use super::flight_number::FlightNumber;
use super::folder::FolderOutlet;
use super::offer::{OfferedModel, Order};
use super::receipt::Delivery;
use super::transport::{Outlet, TransportError};
use super::{Source, UploadError, territory};

/// A model that took so long to deliver keeps the next checkpoint back for so many times as long.
const REST: f64 = 4.0;

/// What has become of the offers so far.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OffererStatus {
    /// Models offered.
    pub offers: u64,
    /// Bytes of the newest one.
    pub bytes: u64,
    /// Bytes of offers and chunks that left the aircraft, those of models that were replaced included.
    pub sent: u64,
    /// Failed attempts, each of which is repeated.
    pub failures: u64,
    /// The newest model has arrived on the ground, or lies complete in the folder.
    pub delivered: bool,
    /// Why the ground will not take the newest model; empty while it has not said so.
    pub refused: String,
    /// Why the last attempt failed; empty once one worked.
    pub last_error: String,
}

/// What is handed over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// May wait for its turn.
    Checkpoint,
    /// May be the last one ever: the aircraft is in trouble.
    Urgent,
    /// The last one of this flight.
    Final,
}

#[derive(Default)]
struct Inbox {
    /// The newest model not yet taken up; an older one it replaces was never sent, which is as it should be.
    next: Option<(PathBuf, Kind)>,
    /// When the last model will be here, if anybody knows.
    last: Option<Instant>,
    stop: bool,
    status: OffererStatus,
}

/// Offers models to the ground. Every call returns at once.
pub struct Offerer {
    shared: Arc<(Mutex<Inbox>, Condvar)>,
    thread: Option<JoinHandle<()>>,
    configured: bool,
    checkpoints: bool,
}

fn locked(inbox: &Mutex<Inbox>) -> MutexGuard<'_, Inbox> {
    // Every critical section leaves the data whole, so a panic elsewhere does not make it wrong.
    inbox.lock().unwrap_or_else(PoisonError::into_inner)
}

type Connect = Box<dyn FnMut() -> Result<Box<dyn Outlet>, TransportError> + Send>;

impl Offerer {
    /// Starts the background thread. With neither `folder` nor `connect` set, models stay on the aircraft and
    /// [`Offerer::status`] never says delivered.
    ///
    /// # Errors
    /// Settings that can never work; anything that may come right later (no link, no stick) is retried instead.
    pub fn start(settings: &UploadSettings, source: Source) -> Result<Self, UploadError> {
        settings.check()?;
        let mut ways: Vec<Connect> = Vec::new();
        if let Some(folder) = settings.folder.clone() {
            let source = source.clone();
            ways.push(Box::new(move || Ok(Box::new(FolderOutlet::new(&folder, source.clone())))));
        }
        if !settings.connect.is_empty() {
            #[cfg(feature = "zenoh")]
            {
                let (settings, source) = (settings.clone(), source.clone());
                ways.push(Box::new(move || {
                    let outlet = super::network::NetworkOutlet::open(&settings, source.clone())?;
                    Ok(Box::new(outlet))
                }));
            }
            #[cfg(not(feature = "zenoh"))]
            return Err(UploadError::NoNetwork);
        }
        let configured = !ways.is_empty();
        let shared = Arc::new((Mutex::new(Inbox::default()), Condvar::new()));
        let worker = Worker {
            flight: FlightNumber::begin(source.flight_number.as_deref()),
            settings: settings.clone(),
            source,
            shared: shared.clone(),
            ways: ways.into_iter().map(|connect| Way { connect, outlet: None, behind: false }).collect(),
            model: None,
            counter: 0,
            delivered: false,
            is_fetched: false,
            offered: Instant::now(),
            next_checkpoint: Instant::now(),
        };
        let thread = std::thread::Builder::new()
            .name("upload".into())
            .spawn(move || worker.run())
            .map_err(UploadError::Thread)?;
        Ok(Self { shared, thread: Some(thread), configured, checkpoints: settings.checkpoint_s > 0.0 })
    }

    /// Offers a checkpoint in place of whatever was offered before, as soon as that is not being fetched any more and
    /// `checkpoint_s` has passed. The file may be replaced (by renaming) at any time afterwards.
    pub fn offer(&self, model: &Path) {
        if self.checkpoints {
            self.put(model, Kind::Checkpoint);
        }
    }

    /// Says in how long the last model is expected. A checkpoint that it would replace before another could follow is held back:
    /// the link would carry the same Gaussians twice.
    pub fn expect_last(&self, within: Duration) {
        locked(&self.shared.0).last = Instant::now().checked_add(within);
    }

    /// Offers a checkpoint at once, because it may be the last one.
    pub fn offer_urgently(&self, model: &Path) {
        self.put(model, Kind::Urgent);
    }

    /// Offers the last model of this flight.
    pub fn offer_final(&self, model: &Path) {
        self.put(model, Kind::Final);
    }

    fn put(&self, model: &Path, kind: Kind) {
        let mut inbox = locked(&self.shared.0);
        inbox.next = Some((model.into(), kind));
        inbox.status.delivered = false;
        inbox.status.refused.clear();
        self.shared.1.notify_all();
    }

    /// What has become of the offers so far.
    pub fn status(&self) -> OffererStatus {
        locked(&self.shared.0).status.clone()
    }

    /// Waits until the newest model has arrived, at most `timeout`, and no longer than `go_on` holds (asked ten
    /// times a second). Returns whether it arrived; at once when there is nowhere it could, or the ground refused it.
    pub fn wait_delivered(&self, timeout: Duration, mut go_on: impl FnMut() -> bool) -> bool {
        if !self.configured {
            return false;
        }
        let until = Instant::now() + timeout;
        while go_on() && Instant::now() < until {
            let OffererStatus { delivered, refused, .. } = self.status();
            if delivered || !refused.is_empty() {
                return delivered;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        locked(&self.shared.0).status.delivered
    }

    /// Stops offering. What the ground has fetched so far stays there.
    pub fn shutdown(mut self) {
        self.stop();
    }

    fn stop(&mut self) {
        locked(&self.shared.0).stop = true;
        self.shared.1.notify_all();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::warn!("upload: the background thread ended abnormally");
        }
    }
}

impl Drop for Offerer {
    fn drop(&mut self) {
        self.stop();
    }
}

struct Way {
    connect: Connect,
    outlet: Option<Box<dyn Outlet>>,
    /// The newest model has not been put on offer here yet.
    behind: bool,
}

struct Worker {
    settings: UploadSettings,
    source: Source,
    flight: FlightNumber,
    shared: Arc<(Mutex<Inbox>, Condvar)>,
    ways: Vec<Way>,
    model: Option<Arc<OfferedModel>>,
    counter: u64,
    /// What became of `model`.
    delivered: bool,
    is_fetched: bool,
    offered: Instant,
    /// Before this time no further checkpoint is offered.
    next_checkpoint: Instant,
}

impl Worker {
    fn run(mut self) {
        // Connect before the first model exists, so that the link is up when it does.
        let mut pause = self.settings.retry_min_s;
        loop {
            let failed = self.catch_up();
            pause = if failed { (2.0 * pause).min(self.settings.retry_max_s) } else { self.settings.retry_min_s };
            let waiting = self.model.is_some() && !self.note_delivery();
            let wait = match (failed, waiting) {
                (true, _) => Duration::from_secs_f64(pause),
                (false, true) => Duration::from_millis(200),
                (false, false) => Duration::from_secs(3600),
            };
            let Some(next) = self.wait(wait) else { return };
            if let Some((path, kind)) = next {
                self.take_up(&path, kind);
            }
        }
    }

    /// Waits until there is something to do; None = stop.
    fn wait(&self, wait: Duration) -> Option<Option<(PathBuf, Kind)>> {
        let (inbox, changed) = &*self.shared;
        let mut inbox = locked(inbox);
        let due = |inbox: &Inbox| inbox.next.as_ref().is_some_and(|n| self.is_due(n.1, inbox.last) || inbox.stop);
        if !due(&inbox) && !inbox.stop {
            let held_back = inbox.next.is_some();
            let left = self.next_checkpoint.saturating_duration_since(Instant::now());
            let wait = if held_back { wait.min(left.max(Duration::from_millis(200))) } else { wait };
            inbox = changed.wait_timeout(inbox, wait).map_or_else(|e| e.into_inner().0, |(guard, _)| guard);
        }
        // What still lies in the inbox is put on offer even when asked to stop: a folder takes it at once.
        match due(&inbox) {
            true => Some(inbox.next.take()),
            false if inbox.stop => None,
            false => Some(None),
        }
    }

    /// A checkpoint waits until the one before has been fetched, if somebody is about it, for its share of the link, and for
    /// the last model where that is near; not long beyond when it was expected, for training may rest meanwhile.
    fn is_due(&self, kind: Kind, last: Option<Instant>) -> bool {
        let busy = self.is_fetched && !self.delivered;
        let now = Instant::now();
        let replaced = last.is_some_and(|last| now < last + self.spacing() && last < now + self.spacing());
        kind != Kind::Checkpoint || (!busy && !replaced && now >= self.next_checkpoint)
    }

    /// From one checkpoint to the next, at least.
    fn spacing(&self) -> Duration {
        Duration::from_secs_f64(self.settings.checkpoint_s)
    }

    fn take_up(&mut self, path: &Path, kind: Kind) {
        let order = Order { flight: self.flight.get(), counter: self.counter + 1 };
        let rounded = match self.settings.encoding {
            Encoding::Exact => None,
            // Rather the whole file than none: the disk may be too full for another.
            Encoding::Delivery => write_delivery(&self.source, path)
                .inspect_err(|e| tracing::warn!("upload: {e}; the exact model is offered instead"))
                .ok(),
        };
        match OfferedModel::open(
            rounded.as_deref().unwrap_or(path),
            &self.settings,
            &self.source,
            order,
            kind == Kind::Final,
        ) {
            Ok(model) => {
                let mut inbox = locked(&self.shared.0);
                inbox.status.offers += 1;
                inbox.status.bytes = model.offer.size;
                drop(inbox);
                self.put_on_offer(model);
            }
            Err(e) => self.note_failure(&format!("{}: {e}", path.display())),
        }
    }

    fn put_on_offer(&mut self, model: OfferedModel) {
        self.counter = model.offer.order.counter;
        for way in &mut self.ways {
            way.behind = true;
        }
        self.model = Some(Arc::new(model));
        (self.delivered, self.is_fetched) = (false, false);
        self.offered = Instant::now();
        self.next_checkpoint = self.offered + self.spacing();
    }

    /// Brings every way up to the newest model; returns whether one of them failed.
    fn catch_up(&mut self) -> bool {
        let mut errors = Vec::new();
        for way in &mut self.ways {
            if way.outlet.is_none() {
                match (way.connect)() {
                    Ok(outlet) => way.outlet = Some(outlet),
                    Err(e) => errors.push(e.to_string()),
                }
            }
            if let (Some(outlet), Some(model), true) = (&mut way.outlet, &self.model, way.behind) {
                match outlet.offer(model) {
                    Ok(()) => way.behind = false,
                    Err(e) => errors.push(format!("{}: {e}", outlet.name())),
                }
            }
        }
        for e in &errors {
            self.note_failure(e);
        }
        if errors.is_empty() {
            locked(&self.shared.0).status.last_error.clear();
        }
        !errors.is_empty()
    }

    fn note_failure(&self, what: &str) {
        let mut inbox = locked(&self.shared.0);
        inbox.status.failures += 1;
        if inbox.status.last_error != what {
            tracing::warn!("upload: {what}; will try again");
            inbox.status.last_error = what.into();
        }
    }

    /// Looks what has become of the model on offer; returns whether there is nothing to wait for any more.
    fn note_delivery(&mut self) -> bool {
        let Some(model) = self.model.clone() else { return true };
        let caught_up = self.ways.iter_mut().filter(|w| !w.behind).filter_map(|w| w.outlet.as_mut());
        let deliveries: Vec<Delivery> = caught_up.map(|o| o.delivery(&model.offer)).collect();
        let sent = self.ways.iter().filter_map(|w| w.outlet.as_ref()).map(|outlet| outlet.sent()).sum();
        locked(&self.shared.0).status.sent = sent;
        let newest =
            deliveries.iter().filter_map(|d| if let Delivery::Behind(order) = d { Some(*order) } else { None });
        if let Some(order) = newest.max() {
            tracing::warn!("upload: the ground has a model of flight {} already; ours is numbered anew", order.flight);
            self.flight.advance_beyond(order.flight);
            let order = Order { flight: self.flight.get(), counter: 1 };
            match model.renumbered(order, &self.source.identity) {
                Ok(model) => self.put_on_offer(model),
                Err(e) => self.note_failure(&e.to_string()),
            }
            return false;
        }
        let delivered = deliveries.contains(&Delivery::Delivered);
        self.is_fetched |= delivered || deliveries.contains(&Delivery::Fetching);
        if delivered && !self.delivered {
            let rest = self.offered.elapsed().mul_f64(REST).as_secs_f64().max(self.settings.checkpoint_s);
            self.next_checkpoint = self.offered + Duration::from_secs_f64(rest);
        }
        self.delivered = delivered;
        let refused = deliveries.iter().find_map(|d| if let Delivery::Refused(why) = d { Some(why) } else { None });
        let mut inbox = locked(&self.shared.0);
        let current = inbox.next.is_none();
        inbox.status.delivered = delivered && current;
        if let Some(why) = refused
            && current
            && inbox.status.refused != *why
        {
            tracing::error!("upload: the ground refuses our model: {why}");
            inbox.status.refused.clone_from(why);
        }
        delivered
    }
}

/// Writes the delivery encoding of a model beside it, without cells that are others' to deliver.
fn write_delivery(source: &Source, path: &Path) -> Result<PathBuf, FormatError> {
    let (header, cloud) = model::read(path)?;
    let rounded = path.with_extension("delivery.dgtr");
    let margin = territory::margin(&header, cloud.middle()[2]);
    // A model that does not lie in the mission's frame has no place among regions.
    let territory = source.territory.as_ref().filter(|_| header.origin.is_some());
    let wanted = |grid: Grid, key: CellKey| territory.is_none_or(|t| t.wants(grid, key, margin));
    model::write_cells(&source.disk, &rounded, &header, &cloud, &Rounding::default(), &wanted)?;
    Ok(rounded)
}

#[cfg(test)]
mod tests;
