//! The ground station's job: receive the models of all aircraft of a mission, then merge them.
//!
//! It may be stopped and started again at any time: what has been received stays in `out/received`, what has been
//! merged in `out/global.dgtr`.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use config::mission::Mission;

use crate::aggregate::{self, AggregateError, LocalModel, Outcome};
use crate::upload::UploadError;
use crate::upload::receive::{ReceiveCounters, Received, Receiver};

/// Why nothing could be served or merged.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// Receiving.
    #[error(transparent)]
    Upload(#[from] UploadError),
    /// Merging.
    #[error(transparent)]
    Aggregate(#[from] AggregateError),
    /// Stopped or timed out before any model was complete.
    #[error("no model of mission {0:?} has arrived yet; start again to continue receiving")]
    Nothing(String),
}

/// What is told while receiving.
#[derive(Clone, Debug)]
pub struct Progress {
    /// Aircraft whose last model is here.
    pub finished: usize,
    /// All aircraft.
    pub aircraft: usize,
    /// Per aircraft with a transfer under way: name, chunks here, chunks of the model.
    pub transfers: Vec<(String, usize, usize)>,
    /// Bytes received by this run.
    pub bytes: u64,
}

/// What came in.
#[derive(Clone, Debug)]
pub struct Reception {
    /// Complete models.
    pub received: Vec<Received>,
    /// Aircraft without a final model.
    pub missing: Vec<String>,
    /// What happened on the way.
    pub counters: ReceiveCounters,
    /// Seconds.
    pub seconds: f64,
}

/// Receives until the last model of every aircraft is here, `timeout`, or `stop`.
///
/// # Errors
/// No transport configured, an endpoint that cannot be listened on, or the ground's own disk.
pub fn receive(
    mission: &Mission,
    out: &Path,
    timeout: Option<Duration>,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(&Progress),
) -> Result<Reception, UploadError> {
    mission.upload.validate()?;
    let start = Instant::now();
    let ids: Vec<String> = mission.aircraft.iter().map(|a| a.id.clone()).collect();
    let mut receiver = Receiver::open(&mission.upload, &mission.name, &ids, &out.join("received"))?;
    let over = || stop.load(std::sync::atomic::Ordering::Relaxed) || timeout.is_some_and(|t| start.elapsed() >= t);
    loop {
        let more = receiver.round(stop)?;
        let received = receiver.received();
        tell(&Progress {
            finished: received.iter().filter(|r| r.finished).count(),
            aircraft: ids.len(),
            transfers: receiver.progress().into_iter().filter(|p| p.2 > 0).collect(),
            bytes: receiver.counters.bytes,
        });
        if receiver.all_finished() || over() {
            break;
        }
        if !more {
            receiver.wait();
        }
    }
    let received = receiver.received();
    let is_here = |id: &String| received.iter().any(|r| r.finished && r.aircraft == *id);
    Ok(Reception {
        missing: ids.iter().filter(|id| !is_here(id)).cloned().collect(),
        counters: receiver.counters,
        seconds: start.elapsed().as_secs_f64(),
        received,
    })
}

/// Merges what has been received, around the mission's origin. A received model that cannot be read is left out and
/// returned with its reason, so that one bad file does not cost the others.
///
/// # Errors
/// Nothing readable has arrived, or what has does not belong together.
pub fn merge(
    mission: &Mission,
    reception: &Reception,
    out: &Path,
    go_on: &dyn Fn() -> bool,
) -> Result<(Outcome, Vec<(PathBuf, AggregateError)>), ServeError> {
    let (mut models, mut unreadable) = (Vec::new(), Vec::new());
    for r in &reception.received {
        match LocalModel::read(&r.path) {
            Ok(mut model) => {
                // The mission says who flew where; a model made by hand may not.
                model.header.origin.get_or_insert(mission.origin);
                if model.header.region.is_empty()
                    && let Ok(aircraft) = mission.aircraft(Some(&r.aircraft))
                {
                    model.header.region = mission.region(aircraft);
                    if let Some(own) = model.header.origin {
                        let motion = aggregate::frame::Motion::between(mission.origin, own);
                        motion.corners(&mut model.header.region);
                    }
                }
                model.header.aircraft.clone_from(&r.aircraft);
                models.push(model);
            }
            Err(e) => unreadable.push((r.path.clone(), e)),
        }
    }
    if models.is_empty() {
        return match unreadable.into_iter().next() {
            Some((_, e)) => Err(e.into()),
            None => Err(ServeError::Nothing(mission.name.clone())),
        };
    }
    let outcome = aggregate::run(models, &mission.ground, Some(mission.origin), out, go_on)?;
    Ok((outcome, unreadable))
}

#[cfg(test)]
mod tests;
