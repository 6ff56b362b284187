//! The aircraft's side: keeps the newest model on offer, in the background.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use config::upload::UploadSettings;

use super::UploadError;
use super::folder::FolderOutlet;
use super::offer::{Hash, OfferedModel};
use super::transport::{Outlet, TransportError};

/// What has become of the offers so far.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OffererStatus {
    /// Models offered.
    pub offers: u64,
    /// Bytes of the newest one.
    pub bytes: u64,
    /// Failed attempts, each of which is repeated.
    pub failures: u64,
    /// The newest model has arrived on the ground, or lies complete in the folder.
    pub delivered: bool,
    /// Why the last attempt failed; empty once one worked.
    pub last_error: String,
}

#[derive(Default)]
struct Inbox {
    /// The newest model not yet taken up; an older one it replaces was never sent, which is as it should be.
    next: Option<(PathBuf, bool)>,
    stop: bool,
    status: OffererStatus,
}

/// Offers models to the ground. Every call returns at once.
pub struct Offerer {
    shared: Arc<(Mutex<Inbox>, Condvar)>,
    thread: Option<JoinHandle<()>>,
    configured: bool,
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
    pub fn start(settings: &UploadSettings, mission: &str, aircraft: &str) -> Result<Self, UploadError> {
        settings.validate()?;
        let mut ways: Vec<Connect> = Vec::new();
        if let Some(folder) = settings.folder.clone() {
            let (mission, aircraft) = (mission.to_owned(), aircraft.to_owned());
            ways.push(Box::new(move || Ok(Box::new(FolderOutlet::new(&folder, &mission, &aircraft)))));
        }
        if !settings.connect.is_empty() {
            #[cfg(feature = "zenoh")]
            {
                let (settings, mission, aircraft) = (settings.clone(), mission.to_owned(), aircraft.to_owned());
                ways.push(Box::new(move || {
                    let outlet = super::network::NetworkOutlet::open(&settings, &mission, &aircraft)?;
                    Ok(Box::new(outlet))
                }));
            }
            #[cfg(not(feature = "zenoh"))]
            return Err(UploadError::NoNetwork);
        }
        let configured = !ways.is_empty();
        let shared = Arc::new((Mutex::new(Inbox::default()), Condvar::new()));
        let worker = Worker {
            settings: settings.clone(),
            mission: mission.into(),
            aircraft: aircraft.into(),
            shared: shared.clone(),
            ways: ways.into_iter().map(|connect| Way { connect, outlet: None, behind: false }).collect(),
            model: None,
            sequence: 0,
        };
        let thread = std::thread::Builder::new()
            .name("upload".into())
            .spawn(move || worker.run())
            .map_err(UploadError::Thread)?;
        Ok(Self { shared, thread: Some(thread), configured })
    }

    /// Offers a checkpoint in place of whatever was offered before. The file may be replaced (by renaming) at any
    /// time afterwards.
    pub fn offer(&self, model: &Path) {
        self.put(model, false);
    }

    /// Offers the last model of this flight.
    pub fn offer_final(&self, model: &Path) {
        self.put(model, true);
    }

    fn put(&self, model: &Path, finished: bool) {
        let mut inbox = locked(&self.shared.0);
        inbox.next = Some((model.into(), finished));
        inbox.status.delivered = false;
        self.shared.1.notify_all();
    }

    /// What has become of the offers so far.
    pub fn status(&self) -> OffererStatus {
        locked(&self.shared.0).status.clone()
    }

    /// Waits until the newest model has arrived, at most `timeout`, and no longer than `go_on` holds (asked ten
    /// times a second). Returns whether it arrived; at once when there is nowhere it could.
    pub fn wait_delivered(&self, timeout: Duration, mut go_on: impl FnMut() -> bool) -> bool {
        if !self.configured {
            return false;
        }
        let until = Instant::now() + timeout;
        while go_on() && Instant::now() < until {
            if locked(&self.shared.0).status.delivered {
                return true;
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
    mission: String,
    aircraft: String,
    shared: Arc<(Mutex<Inbox>, Condvar)>,
    ways: Vec<Way>,
    model: Option<Arc<OfferedModel>>,
    sequence: u64,
}

impl Worker {
    fn run(mut self) {
        // Connect before the first model exists, so that the link is up when it does.
        let mut pause = self.settings.retry_min_s;
        loop {
            let failed = self.catch_up();
            pause = if failed { (2.0 * pause).min(self.settings.retry_max_s) } else { self.settings.retry_min_s };
            let waiting = self.model.is_some() && !self.note_delivery();
            let nap = match (failed, waiting) {
                (true, _) => Duration::from_secs_f64(pause),
                (false, true) => Duration::from_millis(200),
                (false, false) => Duration::from_secs(3600),
            };
            let Some(next) = self.sleep(nap) else { return };
            if let Some((path, finished)) = next {
                self.take_up(&path, finished);
            }
        }
    }

    /// Sleeps until there is something to do; None = stop.
    fn sleep(&self, nap: Duration) -> Option<Option<(PathBuf, bool)>> {
        let (inbox, bell) = &*self.shared;
        let mut inbox = locked(inbox);
        if inbox.next.is_none() && !inbox.stop {
            inbox = bell.wait_timeout(inbox, nap).map_or_else(|e| e.into_inner().0, |(guard, _)| guard);
        }
        // A final model still in the inbox is put on offer even when asked to stop: a folder takes it at once.
        if inbox.stop && inbox.next.is_none() { None } else { Some(inbox.next.take()) }
    }

    fn take_up(&mut self, path: &Path, finished: bool) {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis() as u64);
        let sequence = now.max(self.sequence + 1);
        match OfferedModel::open(path, &self.settings, (&self.mission, &self.aircraft), sequence, finished) {
            Ok(model) => {
                self.sequence = sequence;
                for way in &mut self.ways {
                    way.behind = true;
                }
                let mut inbox = locked(&self.shared.0);
                inbox.status.offers += 1;
                inbox.status.bytes = model.offer.size;
                drop(inbox);
                self.model = Some(Arc::new(model));
            }
            Err(e) => self.note_failure(&format!("{}: {e}", path.display())),
        }
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

    fn note_delivery(&self) -> bool {
        let Some(model) = &self.model else { return false };
        let hash: Hash = model.offer.model;
        let delivered = self.ways.iter().any(|w| w.outlet.as_ref().is_some_and(|o| !w.behind && o.is_delivered(&hash)));
        let mut inbox = locked(&self.shared.0);
        inbox.status.delivered = delivered && inbox.next.is_none();
        delivered
    }
}

#[cfg(test)]
mod tests;
