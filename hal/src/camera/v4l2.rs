//! A video device of the kernel (V4L2): `/dev/videoN`, as MJPEG where it can, else as YUYV, at the lens's size. Every picture
//! carries the driver's own time stamp and number, so that its pose is sought where it was taken and what was lost is known.

mod device;
mod stamp;
mod stream;
mod yuyv;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::time::Duration;

use rustix::io::Errno;

use super::picture::Picture;
use super::restart::Restart;
use crate::error::{ErrorKind, HalError};
use crate::traits::{Camera, PictureClues};
use stamp::{Numbers, monotonic_now, on_companion_clock};
use stream::{Stamp, Stream, video};

/// Pictures waiting between the device and us; when nobody fetches them, the newest are dropped (and counted as lost).
const WAITING: usize = 4;

/// How a device is opened: the real one, or a test's.
type Open = dyn Fn() -> Result<Box<dyn Stream>, HalError> + Send + Sync;

struct Grabbed {
    picture: Picture,
    stamp: Stamp,
    /// When it was fetched, CLOCK_MONOTONIC.
    fetched: Duration,
}

/// A video device.
pub struct V4l2Camera {
    device: PathBuf,
    open: Arc<Open>,
    pictures: Receiver<Result<Grabbed, HalError>>,
    streaming: bool,
    restart: Restart,
    numbers: Numbers,
}

impl V4l2Camera {
    /// Opens `device` and has it stream pictures of `size` (width, height).
    ///
    /// # Errors
    /// [`HalError::Video`]: `Invalid` when there is no such device, it may not be opened or gives no such pictures, `Busy`
    /// when another program uses it.
    pub fn open(device: &Path, size: (u32, u32)) -> Result<Self, HalError> {
        let path = device.to_owned();
        Self::start(device, Arc::new(move || device::open(&path, size)))
    }

    fn start(device: &Path, open: Arc<Open>) -> Result<Self, HalError> {
        let pictures = spawn(device, &open)?;
        Ok(Self {
            device: device.into(),
            open,
            pictures,
            streaming: true,
            restart: Restart::default(),
            numbers: Numbers::default(),
        })
    }

    /// The stream is over: opens the device again when its time has come.
    fn revive(&mut self) -> Result<(), HalError> {
        if self.streaming {
            self.stopped();
            return Err(not_understood(&self.device));
        }
        if self.restart.is_due() {
            self.pictures = spawn(&self.device, &self.open).inspect_err(|_| self.restart.failed())?;
            self.streaming = true;
            self.numbers.start_again();
        }
        Ok(())
    }

    fn stopped(&mut self) {
        self.streaming = false;
        self.restart.failed();
    }
}

/// Opens and streams in a thread of its own: the driver waits, and a driver that answers what no driver may must not take the
/// process down.
fn spawn(device: &Path, open: &Arc<Open>) -> Result<Receiver<Result<Grabbed, HalError>>, HalError> {
    let (sender, pictures) = sync_channel(WAITING);
    let (says, opened) = sync_channel(1);
    let (open, path) = (open.clone(), device.to_owned());
    let body = move || match open() {
        Ok(mut stream) => {
            // Nobody hears it when the camera was given up meanwhile; `grab` then ends with its first picture.
            let _ = says.send(Ok(()));
            grab(&path, stream.as_mut(), &sender);
        }
        Err(e) => drop(says.send(Err(e))),
    };
    std::thread::Builder::new().name("v4l2".into()).spawn(body).map_err(|e| while_streaming(device, &e))?;
    opened.recv().unwrap_or_else(|_| Err(not_understood(device)))?;
    Ok(pictures)
}

/// Hands pictures over until the stream ends or nobody listens.
fn grab(device: &Path, stream: &mut dyn Stream, sender: &SyncSender<Result<Grabbed, HalError>>) {
    loop {
        let (bytes, stamp) = match stream.next() {
            Ok((bytes, stamp)) => (bytes.to_vec(), stamp),
            Err(e) => return drop(sender.send(Err(while_streaming(device, &e)))),
        };
        let fetched = monotonic_now();
        let picture = if stamp.damaged { None } else { stream.picture(&bytes) };
        // What is left out shows as a gap in the numbers.
        let Some(picture) = picture else { continue };
        if let Err(TrySendError::Disconnected(_)) = sender.try_send(Ok(Grabbed { picture, stamp, fetched })) {
            return;
        }
    }
}

fn not_understood(device: &Path) -> HalError {
    video(device, ErrorKind::Device, "its driver's answer is not understood; try a command as camera instead")
}

/// A failure of a device that worked: it may come back.
fn while_streaming(device: &Path, error: &io::Error) -> HalError {
    match Errno::from_io_error(error) {
        Some(Errno::NODEV | Errno::NXIO | Errno::NOENT) => {
            video(device, ErrorKind::Closed, "was unplugged; it is opened again when it is back")
        }
        Some(Errno::BUSY) => video(device, ErrorKind::Busy, "is used by another program"),
        _ if error.kind() == io::ErrorKind::TimedOut => {
            video(device, ErrorKind::Closed, "gives no pictures any more; it is opened again")
        }
        _ => video(device, ErrorKind::Closed, format!("{error}; it is opened again")),
    }
}

impl Camera for V4l2Camera {
    type Picture = Picture;
    type Error = HalError;

    fn next_picture(&mut self, now_ns: u64) -> Result<Option<(PictureClues, Picture)>, HalError> {
        let Grabbed { picture, stamp, fetched } = match self.pictures.try_recv() {
            Ok(Ok(grabbed)) => grabbed,
            Ok(Err(e)) => {
                self.stopped();
                return Err(e);
            }
            Err(TryRecvError::Empty) => return Ok(None),
            Err(TryRecvError::Disconnected) => return self.revive().map(|()| None),
        };
        self.restart.works();
        self.numbers.next(stamp.number);
        let now = monotonic_now();
        let clues = PictureClues {
            arrived_ns: on_companion_clock(now_ns, now, fetched),
            stamped_ns: stamp::believed(stamp.taken, fetched).map(|taken| on_companion_clock(now_ns, now, taken)),
            number: Some(u64::from(stamp.number)),
            ..PictureClues::default()
        };
        Ok(Some((clues, picture)))
    }

    fn is_continuous(&self) -> bool {
        true
    }

    fn lost_pictures(&self) -> u64 {
        self.numbers.lost()
    }
}

#[cfg(test)]
mod tests;
