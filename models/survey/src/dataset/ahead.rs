//! Pictures decoded ahead of need, in order, by a few threads: nobody waits for a decoder, and never more pictures exist
//! than there are threads and one.

use std::ops::ControlFlow;
use std::sync::mpsc::sync_channel;

use super::{Dataset, DatasetError, PoseSource};
use models::camera::PosedImage;

impl Dataset {
    /// Gives `take` each of `frames` in order, with its number, as [`Dataset::load_posed`] loads it, until it breaks. At
    /// most `threads` + 1 pictures are held at once, however many there are.
    pub fn load_ahead(
        &self,
        frames: &[usize],
        scale: f64,
        source: PoseSource,
        threads: usize,
        mut take: impl FnMut(usize, Result<PosedImage, DatasetError>) -> ControlFlow<()>,
    ) {
        let threads = threads.clamp(1, frames.len().max(1));
        std::thread::scope(|scope| {
            // Worker w decodes frames w, w + threads, …; a channel without room makes it wait with one picture in hand.
            let workers: Vec<_> = (0..threads)
                .map(|worker| {
                    let (give, get) = sync_channel(0);
                    let own = frames.iter().skip(worker).step_by(threads);
                    scope.spawn(move || {
                        for &i in own {
                            if give.send((i, self.load_posed(i, scale, source))).is_err() {
                                return;
                            }
                        }
                    });
                    get
                })
                .collect();
            for turn in 0..frames.len() {
                let Ok((i, picture)) = workers[turn % threads].recv() else { return };
                if take(i, picture).is_break() {
                    return;
                }
            }
        });
    }
}
