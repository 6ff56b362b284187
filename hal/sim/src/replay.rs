//! Recordings played back as a living aircraft: a folder of posed photographs ([`play`]), or a telemetry log with a
//! simulated camera ([`play_tlog`]).

mod playlist;
mod recording;
mod tlog;

#[cfg(test)]
mod tests;

use std::io::Read;
use std::path::Path;
use std::sync::atomic::AtomicBool;

pub use playlist::{Playlist, PlaylistItem};
pub use recording::Recording;
pub use tlog::{TlogReport, TlogSettings, play_tlog};

use crate::SimError;
use crate::autopilot::{Autopilot, AutopilotSettings};
use crate::photographer::Photographer;
use crate::session::{self, SessionReport, SessionSettings};
use hal::link::LinkAddress;

/// A photograph has no more; what lies behind is not sent.
const MOST_BYTES: u64 = 1 << 30;

/// How a playlist is played.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplaySettings {
    /// Ids, clocks, signing and faults of the autopilot that is played.
    pub autopilot: AutopilotSettings,
    /// Speed and waiting.
    pub session: SessionSettings,
    /// Pauses between two pictures longer than this are shortened to it, seconds of flight.
    pub longest_gap_s: f64,
    /// From the trigger to the middle of the exposure, seconds of flight.
    pub shutter_delay_s: f64,
    /// From the exposure to the finished file, seconds of flight.
    pub transfer_s: f64,
}

impl Default for ReplaySettings {
    fn default() -> Self {
        Self {
            autopilot: AutopilotSettings { gps_sigma_m: 1.5, ..AutopilotSettings::default() },
            session: SessionSettings::default(),
            longest_gap_s: 30.0,
            shutter_delay_s: 0.0,
            transfer_s: 0.3,
        }
    }
}

/// Plays `playlist` as an autopilot on `address`, and its pictures into `camera_dir` at their time.
///
/// Position and attitude between the pictures are interpolated smoothly; at every exposure they are the playlist's.
/// `on_ready` is told the path of the pseudo-terminal for `pty:` (else `None`); `stop` ends the replay early.
///
/// # Errors
/// An empty playlist, a picture that cannot be read, a link or folder that cannot be used.
pub fn play(
    playlist: &Playlist,
    settings: &ReplaySettings,
    address: &LinkAddress,
    camera_dir: Option<&Path>,
    stop: &AtomicBool,
    on_ready: &mut dyn FnMut(Option<&Path>),
) -> Result<SessionReport, SimError> {
    settings.session.check()?;
    let flight = playlist.flight(settings)?;
    let link = session::open(address, settings.autopilot.seed, on_ready)?;
    let camera = match camera_dir {
        Some(folder) => {
            let paths: Vec<_> = playlist.items.iter().map(|item| item.picture.clone()).collect();
            let read = move |index: usize| {
                let path: &std::path::PathBuf = &paths[index];
                let mut bytes = Vec::new();
                let read = disk::regular::open(path).and_then(|file| file.take(MOST_BYTES).read_to_end(&mut bytes));
                read.map(|_| bytes).map_err(|source| SimError::Folder { path: path.clone(), source })
            };
            let nothing_more = |_: &AtomicBool| Ok(());
            Some(Photographer::new(folder, flight.exposures.clone(), settings.autopilot.seed, read, nothing_more)?)
        }
        None => None,
    };
    session::fly(Autopilot::new(link, flight, settings.autopilot.clone()), camera, &settings.session, stop)
}
