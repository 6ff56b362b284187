//! The simulated camera: makes pictures ahead of time on a thread of its own and lets each file appear in the camera
//! folder when it is due, whole (written under another name, then renamed), or spoiled as told.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::thread::JoinHandle;

use config::faults::FaultSettings;
use disk::Disk;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, RgbImage};

use super::aircraft::Exposure;
use super::error::SimError;
use super::random::{About, strikes};

/// Pictures made ahead of their time.
const AHEAD: usize = 3;
/// A picture this much after its time was made too slowly for the chosen speed, seconds of flight.
const TARDY_S: f64 = 0.5;

/// What was done with the pictures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PictureCounters {
    /// Files that appeared in the folder.
    pub delivered: u64,
    /// Not delivered.
    pub lost: u64,
    /// Delivered a second time.
    pub twice: u64,
    /// Held back.
    pub late: u64,
    /// Black or overexposed.
    pub spoiled: u64,
    /// Truncated.
    pub cut: u64,
    /// Made later than they were due, because this machine is too slow for the chosen speed.
    pub tardy: u64,
}

struct Delivery {
    due_s: f64,
    name: String,
    bytes: Vec<u8>,
}

/// A camera with its folder.
pub struct Photographer {
    folder: PathBuf,
    exposures: VecDeque<Exposure>,
    /// Exposures whose pictures were made.
    taken: usize,
    made: Receiver<Result<Vec<u8>, SimError>>,
    held: Vec<Delivery>,
    seed: u64,
    counters: PictureCounters,
    /// Wait for a picture that is due and not made yet; else it comes later.
    waits: bool,
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Photographer {
    /// A camera that puts the pictures of `exposures` into `folder` (made if absent). `picture` makes the file of an
    /// exposure by its index; it runs on a thread. `afterwards` runs there when all were taken, unless stopped before.
    ///
    /// # Errors
    /// [`SimError::Folder`].
    pub fn new(
        folder: &Path,
        exposures: Vec<Exposure>,
        seed: u64,
        picture: impl FnMut(usize) -> Result<Vec<u8>, SimError> + Send + 'static,
        afterwards: impl FnOnce(&AtomicBool) -> Result<(), SimError> + Send + 'static,
    ) -> Result<Self, SimError> {
        Self::start(folder, (0..exposures.len()).map(picture), exposures.into(), seed, afterwards)
    }

    /// A camera whose exposures come while it flies, by [`Photographer::expose`]; `pictures` brings the picture of each, in
    /// their order, and ends with the flight. It runs on a thread.
    ///
    /// # Errors
    /// [`SimError::Folder`].
    pub fn on_demand(
        folder: &Path,
        seed: u64,
        pictures: impl Iterator<Item = Result<Vec<u8>, SimError>> + Send + 'static,
    ) -> Result<Self, SimError> {
        Self::start(folder, pictures, VecDeque::new(), seed, |_| Ok(()))
    }

    fn start(
        folder: &Path,
        mut pictures: impl Iterator<Item = Result<Vec<u8>, SimError>> + Send + 'static,
        exposures: VecDeque<Exposure>,
        seed: u64,
        afterwards: impl FnOnce(&AtomicBool) -> Result<(), SimError> + Send + 'static,
    ) -> Result<Self, SimError> {
        std::fs::create_dir_all(folder).map_err(|source| SimError::Folder { path: folder.into(), source })?;
        let (sender, made) = sync_channel(AHEAD);
        let quit = Arc::new(AtomicBool::new(false));
        let quitting = Arc::clone(&quit);
        let thread = std::thread::spawn(move || {
            loop {
                if quitting.load(Ordering::Relaxed) {
                    return;
                }
                let Some(picture) = pictures.next() else { break };
                if sender.send(picture).is_err() {
                    return;
                }
            }
            if let Err(e) = afterwards(&quitting) {
                // The receiver may be gone already: then nobody wants to know.
                let _ = sender.send(Err(e));
            }
        });
        Ok(Self {
            folder: folder.into(),
            exposures,
            taken: 0,
            made,
            held: Vec::new(),
            seed,
            counters: PictureCounters::default(),
            waits: false,
            quit,
            thread: Some(thread),
        })
    }

    /// For a clock that stands still meanwhile: pictures that are due are waited for, so that none is tardy.
    pub fn waiting_for_pictures(self) -> Self {
        Self { waits: true, ..self }
    }

    /// One more exposure, later than those before.
    pub fn expose(&mut self, exposure: Exposure) {
        self.exposures.push_back(exposure);
    }

    /// What was done so far.
    pub fn counters(&self) -> PictureCounters {
        self.counters
    }

    /// True when every picture was delivered, or was never meant to be.
    pub fn done(&self) -> bool {
        self.exposures.is_empty() && self.held.is_empty()
    }

    /// Delivers what is due after `flight_s` seconds of flight.
    ///
    /// # Errors
    /// A picture that could not be made or written.
    pub fn deliver(&mut self, flight_s: f64, acting: &FaultSettings) -> Result<(), SimError> {
        while self.exposures.front().is_some_and(|e| e.ready_s <= flight_s) {
            let made = if self.waits { self.made.recv().map_err(TryRecvError::from) } else { self.made.try_recv() };
            let bytes = match made {
                Ok(made) => made?,
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => return Err(SimError::CameraStopped { made: self.taken }),
            };
            let Some(exposure) = self.exposures.pop_front() else { break };
            self.counters.tardy += u64::from(flight_s > exposure.ready_s + TARDY_S);
            self.taken += 1;
            self.take(flight_s, exposure.name, bytes, acting)?;
        }
        let mut k = 0;
        while k < self.held.len() {
            if self.held[k].due_s <= flight_s {
                let delivery = self.held.swap_remove(k);
                self.write(&delivery.name, &delivery.bytes)?;
            } else {
                k += 1;
            }
        }
        Ok(())
    }

    /// One picture, with what befalls it.
    fn take(
        &mut self,
        flight_s: f64,
        name: String,
        mut bytes: Vec<u8>,
        acting: &FaultSettings,
    ) -> Result<(), SimError> {
        let n = self.taken as u64;
        let seed = self.seed;
        let befalls = |percent, about| strikes(percent, seed, about, 0, n);
        if befalls(acting.picture_loss_pct, About::PictureLoss) {
            self.counters.lost += 1;
            return Ok(());
        }
        let black = befalls(acting.picture_black_pct, About::PictureBlack);
        if black || befalls(acting.picture_over_pct, About::PictureOver) {
            bytes = expose(&bytes, if black { 0.02 } else { 8.0 }, &name)?;
            self.counters.spoiled += 1;
        }
        if befalls(acting.picture_cut_pct, About::PictureCut) {
            bytes.truncate(bytes.len() / 2);
            self.counters.cut += 1;
        }
        if befalls(acting.picture_twice_pct, About::PictureTwice) {
            self.write(&copy_name(&name), &bytes)?;
            self.counters.twice += 1;
        }
        if befalls(acting.picture_late_pct, About::PictureLate) {
            self.held.push(Delivery { due_s: flight_s + f64::from(acting.picture_late_s), name, bytes });
            self.counters.late += 1;
            return Ok(());
        }
        self.write(&name, &bytes)
    }

    fn write(&mut self, name: &str, bytes: &[u8]) -> Result<(), SimError> {
        write_whole(&self.folder.join(name), bytes)?;
        self.counters.delivered += 1;
        Ok(())
    }

    /// Waits for the thread; with `stop` it ends after the picture it is at.
    ///
    /// # Errors
    /// What went wrong in the work after the last picture.
    pub fn finish(mut self, stop: bool) -> Result<PictureCounters, SimError> {
        self.quit.store(stop, Ordering::Relaxed);
        // Empty the channel so that a thread waiting to send comes on.
        let mut failed = None;
        while let Ok(made) = self.made.recv() {
            failed = failed.or(made.err());
        }
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        failed.map_or(Ok(self.counters), Err)
    }
}

/// Name of a second delivery of a picture.
fn copy_name(name: &str) -> String {
    match name.rsplit_once('.') {
        Some((stem, extension)) => format!("{stem}_copy.{extension}"),
        None => format!("{name}_copy"),
    }
}

/// Writes a file so that a reader of its folder sees it whole or not at all.
///
/// # Errors
/// The folder cannot be written to.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), SimError> {
    let written = Disk::default().replace(path, |out| out.write_all(bytes));
    written.map_err(|e| SimError::Folder { path: path.into(), source: e.into() })
}

/// A picture as a JPEG file of good quality.
///
/// # Errors
/// The picture cannot be encoded.
pub fn to_jpeg(picture: &RgbImage) -> Result<Vec<u8>, SimError> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 93)
        .encode(picture.as_raw(), picture.width(), picture.height(), ExtendedColorType::Rgb8)
        .map_err(|e| SimError::Picture { name: "rendered picture".into(), why: e.to_string() })?;
    Ok(bytes)
}

/// Multiplies the light of a picture.
fn expose(bytes: &[u8], gain: f32, name: &str) -> Result<Vec<u8>, SimError> {
    let mut picture = image::load_from_memory(bytes)
        .map_err(|e| SimError::Picture { name: name.into(), why: e.to_string() })?
        .to_rgb8();
    for p in picture.iter_mut() {
        *p = (f32::from(*p) * gain).min(255.0) as u8;
    }
    to_jpeg(&picture)
}
