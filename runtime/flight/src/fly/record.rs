//! A flight as an MCAP file, which Foxglove shows: where the aircraft was, exposures, key frames with a small picture, what the
//! job made of them, and what the ground station was told. JSON with Foxglove's own schemas where there are any. A thread of its
//! own writes; capture never waits for it.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use config::error::{Error, ErrorKind};
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};
use hal::mavlink::dialect::MavSeverity;
use hal::vehicle::PoseReport;
use image::RgbImage;
use models::camera::Pose;
use pages::report::craft::Thumbnail;
use pages::report::picture;
use serde_json::{Value, json};

use super::handover::Told;

mod mcap;
mod schemas;

use mcap::Writer;
use schemas::CHANNELS;

/// Largest file: some twelve hours of poses at 10 Hz; a trace may be as large.
const LIMIT: u64 = 256 << 20;
/// What the format takes for a message besides its data, bytes: record, index, and its part of the chunk's.
const FRAMING: u64 = 64;
/// Kept back of the limit for the summary.
const SUMMARY: u64 = 64 << 10;
/// Data of a chunk, and how long it may wait: what a power cut may cost.
const CHUNK: usize = 256 << 10;
const FLUSH_EVERY: Duration = Duration::from_secs(10);
/// Between two looks at whether it is over, while nothing comes.
const PATIENCE: Duration = Duration::from_millis(200);
/// Entries that wait to be written; more are counted and left out.
const WAITING: usize = 256;
/// Poses are in this frame, metres east, north, up of the mission's origin.
const FRAME: &str = "enu";

/// Why there is no recording.
#[derive(Debug, thiserror::Error)]
#[error("--record {}: {}", path.display(), disk::told(source))]
pub struct RecordError {
    path: PathBuf,
    source: std::io::Error,
}

impl Error for RecordError {
    fn kind(&self) -> ErrorKind {
        Error::kind(&self.source)
    }
}

/// Something worth recording.
pub(super) enum Entry {
    Pose(PoseReport),
    Exposure(u32),
    KeyFrame(Pose, Option<RgbImage>),
    State(Told, Seen),
    Words(MavSeverity, String),
}

/// What capture adds to what the job tells.
#[derive(Clone, Copy, Default)]
pub(super) struct Seen {
    pub(super) pictures: u64,
    /// Percent of the region.
    pub(super) covered: u32,
}

/// Takes what happens, and never waits.
#[derive(Clone, Debug, Default)]
pub struct Recorder {
    to: Option<SyncSender<(u64, Entry)>>,
    left_out: Arc<AtomicU64>,
    /// Unix time less the time of the clock that entries are on, ns.
    offset_ns: i64,
}

impl std::fmt::Debug for Entry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("an entry")
    }
}

impl Recorder {
    /// Entries are on a clock that shows `now_ns`.
    pub(super) fn set_clock(&mut self, now_ns: u64) {
        let unix_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        self.offset_ns = i64::try_from(unix_ns).unwrap_or(i64::MAX).saturating_sub_unsigned(now_ns);
    }

    /// Notes a key frame that was taken at `time_ns`, with a small picture.
    pub(super) fn note_key_frame(&self, time_ns: u64, pose: Pose, image: &RgbImage) {
        if self.to.is_some() {
            let mut small = Thumbnail::default();
            small.take(image);
            self.note(time_ns, Entry::KeyFrame(pose, small.image()));
        }
    }

    /// Notes what happened at `time_ns`.
    pub(super) fn note(&self, time_ns: u64, entry: Entry) {
        let Some(to) = &self.to else { return };
        if to.try_send((time_ns.saturating_add_signed(self.offset_ns), entry)).is_err() {
            self.left_out.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// A file that is being written; complete, and closed, when this is dropped.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    left_out: Arc<AtomicU64>,
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<std::io::Result<()>>>,
}

impl Recording {
    /// Begins a file at `path`, of a flight around `origin`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path, origin: Geodetic) -> Result<(Self, Recorder), RecordError> {
        Self::bounded(path, origin, LIMIT)
    }

    /// Most bytes that a recording at `path` takes of `folder`.
    pub fn most_bytes_below(path: &Path, folder: &Path) -> u64 {
        let of = |path: &Path| std::path::absolute(path).and_then(|p| p.parent().unwrap_or(&p).canonicalize()).ok();
        let below = of(path).zip(folder.canonicalize().ok()).is_some_and(|(path, folder)| path.starts_with(folder));
        if below { LIMIT } else { 0 }
    }

    fn bounded(path: &Path, origin: Geodetic, limit: u64) -> Result<(Self, Recorder), RecordError> {
        let failed = |source| RecordError { path: path.into(), source };
        let file = BufWriter::new(disk::regular::create(path).map_err(failed)?);
        let channels = CHANNELS.map(|c| (c.topic, c.name, (c.schema)().to_string()));
        let sheet = Sheet { writer: Writer::new(file, &channels, CHUNK).map_err(failed)?, bytes: 0 };
        let (to, inbox) = sync_channel(WAITING);
        let (left_out, over) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let stop = over.clone();
        let thread = std::thread::Builder::new()
            .name("record".into())
            .spawn(move || sheet.write_all(&inbox, &stop, &EnuFrame::new(origin), limit))
            .map_err(failed)?;
        let recorder = Recorder { to: Some(to), left_out: left_out.clone(), offset_ns: 0 };
        Ok((Self { path: path.into(), left_out, over, thread: Some(thread) }, recorder))
    }
}

/// However the job ends, the file gets its end.
impl Drop for Recording {
    fn drop(&mut self) {
        // A job that failed may leave its capture running.
        self.over.store(true, Ordering::Relaxed);
        let path = self.path.display();
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(Err(e))) => tracing::warn!("{path}: the recording ends before the flight: {}", disk::told(&e)),
            Some(Err(_)) => tracing::warn!("{path}: the recording ended abnormally"),
            _ => {}
        }
        let left_out = self.left_out.load(Ordering::Relaxed);
        if left_out > 0 {
            tracing::warn!("{path}: {left_out} entries came faster than they could be written, or after its end");
        }
    }
}

/// The file, with its channels in the order of [`CHANNELS`].
struct Sheet {
    writer: Writer<BufWriter<File>>,
    /// What its messages take.
    bytes: u64,
}

impl Sheet {
    /// Writes what comes until it is `over` or nobody is there to say more, or until the file is as large as it may be.
    fn write_all(
        mut self,
        inbox: &Receiver<(u64, Entry)>,
        over: &AtomicBool,
        frame: &EnuFrame,
        limit: u64,
    ) -> std::io::Result<()> {
        let (mut flushed, mut last) = (Instant::now(), WAITING);
        loop {
            // What waits at the end is still written, and no more than that.
            let ends = over.load(Ordering::Relaxed);
            last -= usize::from(ends);
            let (unix_ns, entry) = match inbox.recv_timeout(if ends { Duration::ZERO } else { PATIENCE }) {
                _ if last == 0 => break,
                Ok(next) => next,
                Err(RecvTimeoutError::Timeout) if !ends => continue,
                Err(_) => break,
            };
            for (topic, message) in messages(unix_ns, &entry, frame) {
                let data = message.to_string();
                let bytes = data.len() as u64 + FRAMING;
                if self.bytes + bytes + SUMMARY > limit {
                    self.writer.finish()?;
                    return Err(std::io::Error::other("it is as large as it may be"));
                }
                if let Some(channel) = CHANNELS.iter().position(|channel| channel.topic == topic) {
                    self.writer.write(channel, unix_ns, data.as_bytes())?;
                }
                self.bytes += bytes;
            }
            if flushed.elapsed() >= FLUSH_EVERY {
                flushed = Instant::now();
                self.writer.flush()?;
            }
        }
        self.writer.finish()?;
        self.writer.get_ref().get_ref().sync_all()
    }
}

/// An entry as messages of topics.
fn messages(unix_ns: u64, entry: &Entry, frame: &EnuFrame) -> Vec<(&'static str, Value)> {
    let timestamp = json!({ "sec": unix_ns / 1_000_000_000, "nsec": unix_ns % 1_000_000_000 });
    let in_frame = |position: DVec3, rotation: DQuat| {
        let (p, q) = (position, rotation);
        let pose = json!({
            "position": { "x": p.x, "y": p.y, "z": p.z },
            "orientation": { "x": q.x, "y": q.y, "z": q.z, "w": q.w },
        });
        json!({ "timestamp": timestamp, "frame_id": FRAME, "pose": pose })
    };
    match entry {
        Entry::Pose(report) => {
            let at = frame.to_geodetic(report.position);
            let [e, n, u] = report.position_sigma_m.map(|s| f64::from(s).powi(2));
            let fix = json!({
                "timestamp": timestamp, "frame_id": "gps", "latitude": at.lat_deg, "longitude": at.lon_deg, "altitude": at.alt_m,
                "position_covariance": [e, 0.0, 0.0, 0.0, n, 0.0, 0.0, 0.0, u], "position_covariance_type": 2,
            });
            vec![("/aircraft/pose", in_frame(report.position, report.rotation)), ("/aircraft/fix", fix)]
        }
        Entry::Exposure(sequence) => vec![("/exposure", json!({ "timestamp": timestamp, "sequence": sequence }))],
        Entry::KeyFrame(pose, image) => {
            let encoded = image.as_ref().and_then(|image| picture::encode(image).ok());
            let picture = encoded.map(|(kind, bytes)| {
                let (data, format) = (BASE64_STANDARD.encode(bytes), kind.trim_start_matches("image/"));
                json!({ "timestamp": timestamp, "frame_id": "camera", "data": data, "format": format })
            });
            let pose = ("/keyframe/pose", in_frame(pose.center, pose.rotation));
            std::iter::once(pose).chain(picture.map(|picture| ("/keyframe/image", picture))).collect()
        }
        Entry::State(told, seen) => {
            let state = json!({
                "timestamp": timestamp, "state": told.activity.name(), "failsafe": told.rung.name(), "pictures": seen.pictures,
                "key_frames": told.key_frames, "covered_pct": seen.covered, "gaussians": told.gaussians,
                "trained": told.progress, "loss": told.loss,
            });
            vec![("/state", state)]
        }
        Entry::Words(severity, text) => {
            // foxglove.Log: 2 information, 3 warning, 4 error.
            let level = match *severity as u8 {
                0..=3 => 4,
                4 => 3,
                _ => 2,
            };
            let log = json!({
                "timestamp": timestamp, "level": level, "message": text, "name": "dgtr", "file": "", "line": 0,
            });
            vec![("/log", log)]
        }
    }
}

#[cfg(test)]
mod tests;
