//! The thread that offers: connects, puts models on offer, tries again, and looks what has become of them.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use config::upload::UploadSettings;
use models::formats::{FormatError, delivery::Rounding, model};
use models::ground_cell::{CellKey, Grid};

use super::inbox::{Inbox, Kind, locked};
use crate::flight_number::FlightNumber;
use crate::heartbeat::{EVERY, Heartbeat};
use crate::offer::{OfferedModel, Order};
use crate::receipt::Delivery;
use crate::transport::{Outlet, TransportError};
use crate::{Source, territory};

/// A model that took so long to deliver keeps the next checkpoint back for so many times as long.
const REST: f64 = 4.0;

/// Opens a way, again and again until it works.
pub(super) type Connect = Box<dyn FnMut() -> Result<Box<dyn Outlet>, TransportError> + Send>;

/// One way to the ground.
struct Way {
    connect: Connect,
    outlet: Option<Box<dyn Outlet>>,
    /// The newest model has not been put on offer here yet.
    behind: bool,
}

/// The background thread: keeps the newest model on offer on every way.
pub(super) struct Worker {
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
    /// Heartbeats so far, and when the next one is due.
    heartbeats: u64,
    next_heartbeat: Instant,
}

impl Worker {
    /// With nothing on offer yet.
    pub fn new(
        settings: UploadSettings,
        source: Source,
        shared: Arc<(Mutex<Inbox>, Condvar)>,
        ways: Vec<Connect>,
    ) -> Self {
        Self {
            flight: FlightNumber::begin(source.flight_number.as_deref()),
            settings,
            source,
            shared,
            ways: ways.into_iter().map(|connect| Way { connect, outlet: None, behind: false }).collect(),
            model: None,
            counter: 0,
            delivered: false,
            is_fetched: false,
            offered: Instant::now(),
            next_checkpoint: Instant::now(),
            heartbeats: 0,
            next_heartbeat: Instant::now(),
        }
    }

    /// Until it is asked to stop.
    pub fn run(mut self) {
        // Connect before the first model exists, so that the link is up when it does.
        let mut pause = self.settings.retry_min_s;
        loop {
            let failed = self.catch_up();
            self.say();
            pause = if failed { (2.0 * pause).min(self.settings.retry_max_s) } else { self.settings.retry_min_s };
            let waiting = self.model.is_some() && !self.note_delivery();
            let wait = match (failed, waiting) {
                (true, _) => Duration::from_secs_f64(pause),
                (false, true) => Duration::from_millis(200),
                (false, false) => Duration::from_secs(3600),
            };
            let wait = if self.ways.is_empty() { wait } else { wait.min(EVERY) };
            let Some(next) = self.wait(wait) else { return };
            if let Some((path, kind)) = next {
                self.take_up(&path, kind);
            }
        }
    }

    /// Says how the aircraft is, when that is due.
    fn say(&mut self) {
        if Instant::now() < self.next_heartbeat {
            return;
        }
        self.next_heartbeat = Instant::now() + EVERY;
        self.heartbeats += 1;
        let order = Order { flight: self.flight.get(), counter: self.heartbeats };
        let heartbeat = Heartbeat::new(order, locked(&self.shared.0).condition);
        self.ways.iter_mut().filter_map(|way| way.outlet.as_mut()).for_each(|outlet| outlet.say(&heartbeat));
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
        let rounded = Rounding::of(self.settings.encoding).and_then(|rounding| {
            // Rather the whole file than none: the disk may be too full for another.
            write_delivery(&self.source, path, &rounding)
                .inspect_err(|e| tracing::warn!("upload: {e}; the exact model is offered instead"))
                .ok()
        });
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
fn write_delivery(source: &Source, path: &Path, rounding: &Rounding) -> Result<PathBuf, FormatError> {
    let (header, cloud) = model::read(path)?;
    let rounded = path.with_extension("delivery.dgtr");
    let margin = territory::margin(&header, cloud.middle()[2]);
    // A model that does not lie in the mission's frame has no place among regions.
    let territory = source.territory.as_ref().filter(|_| header.origin.is_some());
    let wanted = |grid: Grid, key: CellKey| territory.is_none_or(|t| t.wants(grid, key, margin));
    model::write_cells(&source.disk, &rounded, &header, &cloud, rounding, &wanted)?;
    Ok(rounded)
}
