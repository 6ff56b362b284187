//! Models are fitted onto their neighbours as they arrive, while others still fly: when the last one is here, what is left to do
//! is the graph over all of them. What is fitted lies in the ground's folder, where the merge finds it.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use config::mission::Mission;

use super::{Received, admit};
use crate::jobs::aggregate::REGISTRATION;
use crate::jobs::planning::registrar;
use crate::member::{Member, unify};

/// How often a waiting ground says that it is alive.
const LOOK_UP: Duration = Duration::from_millis(100);

/// A model that is here to stay.
struct Arrival {
    aircraft: String,
    path: PathBuf,
}

/// What was done while others still flew.
#[derive(Clone, Debug, Default)]
pub struct Joined {
    /// Pairs fitted for each model, in the order they arrived.
    pub fits: Vec<usize>,
    /// Seconds of each from when it was looked at until it was fitted.
    pub seconds: Vec<f64>,
}

/// Fits what arrives in a thread of its own.
pub struct Joining {
    queue: Option<Sender<Arrival>>,
    worker: Option<JoinHandle<Joined>>,
    /// Which file of an aircraft was handed over last.
    seen: HashMap<String, (SystemTime, u64)>,
}

impl Joining {
    /// Ready for the first model; the device is opened when two of them have ground in common.
    pub fn start(mission: &Mission, out: &Path) -> Self {
        let mut this = Self { queue: None, worker: None, seen: HashMap::new() };
        if !mission.ground.register || mission.aircraft.len() < 2 {
            return this;
        }
        let (sender, queue) = channel();
        let (mission, out) = (mission.clone(), out.to_owned());
        match std::thread::Builder::new().name("register".into()).spawn(move || work(&mission, &out, &queue)) {
            Ok(worker) => (this.queue, this.worker) = (Some(sender), Some(worker)),
            // The merge fits everything then.
            Err(e) => tracing::debug!("serve: models are fitted at the end only: {e}"),
        }
        this
    }

    /// Hands over the final models that were not here before.
    pub fn arrived(&mut self, received: &[Received]) {
        let Some(queue) = &self.queue else { return };
        for model in received.iter().filter(|r| r.finished) {
            let changed = std::fs::metadata(&model.path).and_then(|file| file.modified());
            let Ok(file) = changed.map(|at| (at, model.size)) else { continue };
            if self.seen.insert(model.aircraft.clone(), file) != Some(file) {
                // A worker that has given up has said why.
                let _ = queue.send(Arrival { aircraft: model.aircraft.clone(), path: model.path.clone() });
            }
        }
    }

    /// Waits until everything that arrived is fitted; `alive` is called meanwhile.
    pub fn finish(mut self, alive: &dyn Fn()) -> Joined {
        self.queue = None;
        let Some(worker) = self.worker.take() else { return Joined::default() };
        while !worker.is_finished() {
            alive();
            std::thread::sleep(LOOK_UP);
        }
        // Whatever ended it, the merge does what is left.
        worker.join().unwrap_or_default()
    }
}

fn work(mission: &Mission, out: &Path, queue: &Receiver<Arrival>) -> Joined {
    let mut registrar = registrar(&mission.ground, &out.join(REGISTRATION));
    let mut members: Vec<Member> = Vec::new();
    let mut joined = Joined::default();
    for Arrival { aircraft, path } in queue {
        let start = Instant::now();
        // What does not count is named where it is merged.
        let Ok(model) = admit::admit(mission, &aircraft, &path) else { continue };
        let mut member = [Member::of(model)];
        if unify(&mut member, Some(mission.origin)).is_err() {
            continue;
        }
        members.retain(|m| m.name() != aircraft);
        members.extend(member);
        match registrar.fit(&members, &|| false) {
            Ok(fitted) => joined.fits.push(fitted),
            // The merge meets it again and says so.
            Err(e) => {
                tracing::debug!("serve: fitting stopped: {e}");
                break;
            }
        }
        joined.seconds.push(start.elapsed().as_secs_f64());
    }
    joined
}
