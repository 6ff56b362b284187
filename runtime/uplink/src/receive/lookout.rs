//! Looks for offers beside the transfers, each look in a thread of its own: whoever never answers makes one long and delays nothing.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::super::admission::Refusals;
use super::super::transport::Patience;
use super::offered::Offered;
use super::slot::Link;
use super::{ANSWER, ReceiveCounters, STACK_BYTES};

/// When no answer has come for so long, those that came are acted upon.
pub(super) const QUIET: Duration = Duration::from_millis(100);
/// Looks that may wait for answers at the same time.
const AT_ONCE: u32 = 8;
/// Answers of one look that wait to be checked; each may be as long as an offer.
const WAITING: usize = 4;
/// Answers checked in one go.
const IN_ONE_GO: usize = 64;

enum Answer {
    /// An offer, unchecked, and the inlet that shows it.
    Shown(usize, Vec<u8>),
    /// An inlet failed.
    Failed(String),
}

struct Look {
    /// Counts looks.
    number: u64,
    answers: Receiver<Answer>,
    worker: JoinHandle<()>,
    offered: Offered,
    /// When the last answer came.
    heard: Instant,
    /// Something came since it was acted upon.
    is_fresh: bool,
}

/// What a pass over the looks brought.
pub(super) struct News {
    /// What is shown, of the aircraft in it.
    pub(super) offered: Offered,
    /// The look is over: whoever is not in it shows nothing.
    pub(super) is_over: bool,
}

/// The looks under way.
#[derive(Default)]
pub(super) struct Lookout {
    looks: Vec<Look>,
    begun: Option<Instant>,
    /// Looks begun, and the newest one that was acted upon: what an older one still brings is not what is shown now.
    numbers: u64,
    newest: u64,
}

impl Lookout {
    /// Whether answers are still waited for.
    pub(super) fn is_waiting(&self) -> bool {
        !self.looks.is_empty()
    }

    /// Begins a look, unless one began just now. While others wait for answers, as often as lets no more than [`AT_ONCE`] of them.
    pub(super) fn begin(&mut self, link: &Arc<Link>) -> std::io::Result<()> {
        let spacing = if self.looks.is_empty() { Duration::ZERO } else { ANSWER / AT_ONCE };
        let spacing = spacing.max(QUIET.min(Duration::from_secs_f64(link.settings.poll_s / 2.0)));
        if self.begun.is_some_and(|begun| begun.elapsed() < spacing && !self.looks.is_empty()) {
            return Ok(());
        }
        let (sender, answers) = sync_channel(WAITING);
        let link = link.clone();
        let look = move || {
            for (index, inlet) in link.inlets.iter().enumerate() {
                let patience = Patience { limit: ANSWER, stop: &link.stop };
                // Nobody listens any more when the reception ends.
                let outcome =
                    inlet.offers(patience, &mut |bytes| _ = sender.send(Answer::Shown(index, bytes.to_vec())));
                if let Err(e) = outcome {
                    let _ = sender.send(Answer::Failed(format!("{}: {e}", inlet.name())));
                }
            }
        };
        let worker = std::thread::Builder::new().stack_size(STACK_BYTES).spawn(look)?;
        let heard = Instant::now();
        self.numbers += 1;
        let number = self.numbers;
        self.looks.push(Look { number, answers, worker, offered: Offered::default(), heard, is_fresh: false });
        self.begun = Some(heard);
        Ok(())
    }

    /// What has come: of looks that are over, and of those that have been quiet for a while. `before` is what was shown last.
    pub(super) fn news(
        &mut self,
        link: &Link,
        before: &Offered,
        counters: &mut ReceiveCounters,
        refusals: &mut Refusals,
    ) -> Vec<News> {
        let mut news = Vec::new();
        let mut under_way = Vec::with_capacity(self.looks.len());
        for mut look in self.looks.drain(..) {
            let is_over = look.take_in(link, before, counters, refusals);
            if is_over {
                // It has nothing to report.
                let _ = look.worker.join();
                if look.number >= self.newest {
                    self.newest = look.number;
                    news.push(News { offered: look.offered, is_over });
                }
                continue;
            }
            if look.is_fresh && look.heard.elapsed() >= QUIET && look.number >= self.newest {
                (look.is_fresh, self.newest) = (false, look.number);
                news.push(News { offered: look.offered.clone(), is_over });
            }
            under_way.push(look);
        }
        self.looks = under_way;
        news
    }

    /// Waits for the looks under way, whose link has been told to stop.
    pub(super) fn finish(&mut self) {
        for look in self.looks.drain(..) {
            drop(look.answers);
            let _ = look.worker.join();
        }
    }
}

impl Look {
    /// Takes in what waits; returns whether no more will come.
    fn take_in(
        &mut self,
        link: &Link,
        before: &Offered,
        counters: &mut ReceiveCounters,
        refusals: &mut Refusals,
    ) -> bool {
        for _ in 0..IN_ONE_GO {
            match self.answers.try_recv() {
                Ok(Answer::Shown(inlet, bytes)) => {
                    let let_in = |bytes: &[u8]| link.admission.offer(bytes, &link.settings);
                    match self.offered.see(before, &bytes, inlet, let_in) {
                        Ok(()) => (self.heard, self.is_fresh) = (Instant::now(), true),
                        Err(e) => {
                            counters.count_refusal(&e);
                            refusals.count_of_a_stranger(e.to_string());
                        }
                    }
                }
                Ok(Answer::Failed(why)) => {
                    counters.retries += 1;
                    tracing::debug!("serve: {why}");
                }
                Err(TryRecvError::Empty) => return false,
                Err(TryRecvError::Disconnected) => return true,
            }
        }
        false
    }
}
