//! The aircraft's side: keeps the newest model on offer, in the background.

use std::path::Path;
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use config::upload::UploadSettings;

use super::folder::FolderOutlet;
use super::heartbeat::Condition;
use super::{Source, UploadError};
use inbox::{Inbox, Kind, locked};
use worker::{Connect, Worker};

pub use inbox::OffererStatus;

mod inbox;
mod worker;

/// Offers models to the ground. Every call returns at once.
pub struct Offerer {
    shared: Arc<(Mutex<Inbox>, Condvar)>,
    thread: Option<JoinHandle<()>>,
    configured: bool,
    checkpoints: bool,
}

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
        let worker = Worker::new(settings.clone(), source, shared.clone(), ways);
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

    /// Says how the aircraft is; the ground hears of it every two seconds where a network leads there.
    pub fn say(&self, condition: Condition) {
        locked(&self.shared.0).condition = condition;
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

    /// Waits until the newest model has arrived, at most `timeout`, and no longer than until `cancelled` (asked ten
    /// times a second). Returns whether it arrived; at once when there is nowhere it could, or the ground refused it.
    pub fn wait_delivered(&self, timeout: Duration, mut cancelled: impl FnMut() -> bool) -> bool {
        if !self.configured {
            return false;
        }
        let until = Instant::now() + timeout;
        while !cancelled() && Instant::now() < until {
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

#[cfg(test)]
mod tests;
