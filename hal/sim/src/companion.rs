//! A companion for tests: the real [`Vehicle`] at the other end of a pseudo-terminal.

use std::path::Path;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use config::link::LinkSettings;
use config::mission::{CameraSettings, CameraSource};
use geometry::geodesy::Geodetic;

use hal::counters::HalCounters;
use hal::link::LinkAddress;
use hal::vehicle::{Event, PosedPicture, Unmatched, Vehicle, VehicleSettings};

/// What the companion got.
#[derive(Debug, Default)]
pub struct Companion {
    pub frames: Vec<PosedPicture>,
    pub unmatched: Vec<Unmatched>,
    pub links_lost: usize,
    pub links_back: usize,
    pub counters: HalCounters,
}

impl Companion {
    /// The frame of a picture by its file name.
    pub fn frame(&self, name: &str) -> Option<&PosedPicture> {
        self.frames.iter().find(|f| format!("{:?}", f.picture).contains(name))
    }
}

/// Runs `simulate` (which gets the callback for its pseudo-terminal) with a companion listening until it ends.
pub fn accompany<R: Send>(
    origin: Geodetic,
    folder: &Path,
    link: LinkSettings,
    simulate: impl FnOnce(&mut dyn FnMut(Option<&Path>)) -> R + Send,
) -> (R, Companion) {
    let (tell, told) = channel();
    std::thread::scope(|scope| {
        let running =
            scope.spawn(move || simulate(&mut |path| tell.send(path.expect("a pty").to_path_buf()).expect("told")));
        let path = told.recv_timeout(Duration::from_secs(60)).expect("ready");
        let settings = VehicleSettings {
            link,
            camera: Some(CameraSource::Folder(folder.into())),
            ..VehicleSettings::new(
                LinkAddress::Serial { path, baud: 921_600 },
                CameraSettings::pinhole(64, 48, 50.0),
                origin,
            )
        };
        let mut vehicle = Vehicle::open(&settings).expect("opens");
        let mut companion = Companion::default();
        let begun = Instant::now();
        while !running.is_finished() && begun.elapsed() < Duration::from_secs(100) {
            match vehicle.poll(Duration::from_millis(20)).expect("a link") {
                Some(Event::Posed(frame)) => companion.frames.push(frame),
                Some(Event::Unmatched(unmatched)) => companion.unmatched.push(unmatched),
                Some(Event::LinkLost) => companion.links_lost += 1,
                Some(Event::LinkBack) => companion.links_back += 1,
                _ => {}
            }
        }
        companion.counters = vehicle.counters();
        (running.join().expect("no panic"), companion)
    })
}
