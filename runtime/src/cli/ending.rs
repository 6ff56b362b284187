//! A request to stop is obeyed within a bounded time, whatever the job is in the midst of.

use std::time::Duration;

use config::error::ErrorKind;
use job::interrupt::Interrupt;

use super::error::code_of;

/// An orderly end has so long: what is under way is put away in milliseconds, cells and models are long in the making.
const ORDERLY: Duration = Duration::from_secs(4);
const LOOK_UP: Duration = Duration::from_millis(50);

/// Ends the process when it has not ended by itself soon after it was asked to. Files are written aside and renamed, so that nothing
/// is half there, and what is complete is found by the next start.
pub(super) fn within_bounds(stop: &Interrupt) -> std::io::Result<()> {
    let stop = stop.clone();
    let watch = move || {
        while !stop.requested() {
            std::thread::sleep(LOOK_UP);
        }
        std::thread::sleep(ORDERLY);
        tracing::warn!(
            "stopped on request in the midst of a step; what is complete is kept, run the same command again"
        );
        std::process::exit(code_of(ErrorKind::Interrupted).into());
    };
    std::thread::Builder::new().name("ending".into()).spawn(watch).map(drop)
}
