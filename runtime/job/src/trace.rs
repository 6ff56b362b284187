//! What takes how long, as a trace that ui.perfetto.dev and chrome://tracing show: the spans of stages and steps by thread, and the
//! kernels by the device's own clock on a track of theirs.
//!
//! Own lines instead of a crate: those there write without a bound, and none takes a time that another clock has measured.

use std::cell::RefCell;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use config::error::{Error, ErrorKind};
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber, span};
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

use crate::CRATES;

/// Largest file: some two million spans, more than a browser shows without pain.
const LIMIT: u64 = 256 << 20;
/// Kept back of it for the last words.
const LAST_WORDS: u64 = 512;
/// Spans inside of each other on one thread; deeper ones are left out.
const DEPTH: usize = 32;
/// Number of the device's track; threads count from 1.
const DEVICE_TRACK: u32 = 0;

/// Why there is no trace.
#[derive(Debug, thiserror::Error)]
#[error("--trace {}: {}", path.display(), disk::told(source))]
pub struct TraceError {
    path: PathBuf,
    source: std::io::Error,
}

impl Error for TraceError {
    fn kind(&self) -> ErrorKind {
        Error::kind(&self.source)
    }
}

/// A trace that is being written. Written as it happens: what a job leaves that was killed is readable, too, as the format asks for
/// no end.
#[derive(Clone, Debug)]
pub struct Trace(Arc<Mutex<Sheet>>);

#[derive(Debug)]
struct Sheet {
    path: PathBuf,
    file: Option<BufWriter<File>>,
    started: Instant,
    left: u64,
    /// Why it ended before the job.
    ended: Option<String>,
}

impl Sheet {
    /// Writes one event; with the last that fits, why there are no more.
    fn write(&mut self, event: &str) {
        let Some(file) = &mut self.file else { return };
        let bytes = event.len() as u64 + 2;
        let written = if bytes + LAST_WORDS > self.left {
            self.ended = Some("the file is as large as it may be".into());
            let at = self.started.elapsed().as_micros();
            let words =
                format!("{{\"ph\":\"i\",\"s\":\"g\",\"pid\":1,\"tid\":0,\"ts\":{at},\"name\":\"trace is full\"}}\n]\n");
            file.write_all(words.as_bytes()).and_then(|()| file.flush())
        } else {
            self.left -= bytes;
            writeln!(file, "{event},")
        };
        if let Err(e) = written {
            self.ended = Some(disk::told(&e).to_string());
        }
        if self.ended.is_some() {
            self.file = None;
        }
    }
}

/// Whether our own crates say it: what libraries have on their minds is for the log.
pub fn is_ours(what: &tracing::Metadata<'_>) -> bool {
    let name = what.target().split("::").next().unwrap_or_default();
    CRATES.contains(&name)
}

/// Number of a thread in the trace.
fn thread_number() -> (u32, bool) {
    static THREADS: AtomicU32 = AtomicU32::new(DEVICE_TRACK + 1);
    thread_local!(static NUMBER: RefCell<Option<u32>> = const { RefCell::new(None) });
    NUMBER.with_borrow_mut(|number| match *number {
        Some(n) => (n, false),
        None => (*number.insert(THREADS.fetch_add(1, Ordering::Relaxed)), true),
    })
}

fn named(track: u32, name: &str) -> String {
    let name = serde_json::Value::from(name);
    format!("{{\"ph\":\"M\",\"pid\":1,\"tid\":{track},\"name\":\"thread_name\",\"args\":{{\"name\":{name}}}}}")
}

/// A span from `at` to `at + took`, nanoseconds since the trace began; names are ours and need no escaping.
fn spanned(track: u32, name: &str, at_ns: u64, took_ns: u64) -> String {
    let [at, took] = [at_ns, took_ns].map(|ns| ns as f64 * 1e-3);
    format!("{{\"ph\":\"X\",\"pid\":1,\"tid\":{track},\"ts\":{at:.3},\"dur\":{took:.3},\"name\":\"{name}\"}}")
}

thread_local!(static ENTERED: RefCell<([u64; DEPTH], usize)> = const { RefCell::new(([0; DEPTH], 0)) });

impl Trace {
    /// Begins a trace at `path`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path) -> Result<Self, TraceError> {
        Self::bounded(path, LIMIT)
    }

    fn bounded(path: &Path, limit: u64) -> Result<Self, TraceError> {
        let failed = |source| TraceError { path: path.into(), source };
        let mut file = BufWriter::new(disk::regular::create(path).map_err(failed)?);
        file.write_all(b"[\n").map_err(failed)?;
        let sheet = Sheet { path: path.into(), file: Some(file), started: Instant::now(), left: limit, ended: None };
        let trace = Self(Arc::new(Mutex::new(sheet)));
        trace.lock().write(&named(DEVICE_TRACK, "device"));
        Ok(trace)
    }

    fn lock(&self) -> MutexGuard<'_, Sheet> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What listens: to our own spans, and to the device's times.
    pub fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(self) -> impl Layer<S> {
        self.with_filter(filter_fn(|m| match m.is_span() {
            true => is_ours(m),
            false => m.target() == vulkan::stages::DEVICE_TIMES,
        }))
    }

    fn since_start_ns(&self) -> u64 {
        u64::try_from(self.lock().started.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    fn write(&self, track: u32, name: &str, at_ns: u64, took_ns: u64) {
        self.lock().write(&spanned(track, name, at_ns, took_ns));
    }

    /// Ends the file, and says when it had to end before.
    pub fn finish(&self) {
        let (path, ended) = {
            let mut sheet = self.lock();
            let at = sheet.started.elapsed().as_micros();
            let last = format!("{{\"ph\":\"i\",\"s\":\"g\",\"pid\":1,\"tid\":0,\"ts\":{at},\"name\":\"end\"}}\n]\n");
            if let Some(mut file) = sheet.file.take()
                && let Err(e) = file.write_all(last.as_bytes()).and_then(|()| file.flush())
            {
                sheet.ended = Some(disk::told(&e).to_string());
            }
            (sheet.path.clone(), sheet.ended.take())
        };
        if let Some(why) = ended {
            tracing::warn!("{}: the trace ends before the job: {why}", path.display());
        }
    }
}

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Trace {
    fn on_enter(&self, _: &span::Id, _: Context<'_, S>) {
        let now = self.since_start_ns();
        ENTERED.with_borrow_mut(|(since, depth)| {
            if let Some(place) = since.get_mut(*depth) {
                *place = now;
            }
            *depth += 1;
        });
    }

    fn on_exit(&self, id: &span::Id, context: Context<'_, S>) {
        let since = ENTERED.with_borrow_mut(|(since, depth)| {
            *depth = depth.saturating_sub(1);
            since.get(*depth).copied()
        });
        let (Some(since), Some(span)) = (since, context.span(id)) else { return };
        let (track, is_new) = thread_number();
        if is_new {
            self.lock().write(&named(track, std::thread::current().name().unwrap_or("thread")));
        }
        self.write(track, span.name(), since, self.since_start_ns().saturating_sub(since));
    }

    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut kernel = Kernel::default();
        event.record(&mut kernel);
        let began = self.since_start_ns().saturating_sub(kernel.ago_ns);
        self.write(DEVICE_TRACK, kernel.stage, began, kernel.took_ns);
    }
}

/// The device's time of one stage.
#[derive(Default)]
struct Kernel {
    stage: &'static str,
    ago_ns: u64,
    took_ns: u64,
}

impl Visit for Kernel {
    fn record_u64(&mut self, field: &Field, value: u64) {
        match field.name() {
            "stage" => self.stage = vulkan::stages::STAGE_NAMES.get(value as usize).copied().unwrap_or_default(),
            "ago_ns" => self.ago_ns = value,
            "took_ns" => self.took_ns = value,
            _ => {}
        }
    }

    fn record_debug(&mut self, _: &Field, _: &dyn std::fmt::Debug) {}
}

#[cfg(test)]
mod tests {
    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    fn events(path: &Path) -> Vec<serde_json::Value> {
        let text = std::fs::read_to_string(path).expect("the trace");
        serde_json::from_str(&text).unwrap_or_else(|e| panic!("{e}: {text}"))
    }

    #[test]
    fn spans_lie_inside_of_each_other_and_the_devices_times_on_a_track_of_their_own() {
        let dir = tempfile::tempdir().expect("tempdir");
        let path = dir.path().join("trace.json");
        let trace = Trace::create(&path).expect("a file");
        let subscriber = tracing_subscriber::registry().with(trace.clone().layer());
        tracing::subscriber::with_default(subscriber, || {
            let _train = tracing::info_span!("train").entered();
            let _step = tracing::trace_span!("step").entered();
            tracing::trace!(target: vulkan::stages::DEVICE_TIMES, stage = 2u64, ago_ns = 3000u64, took_ns = 2000u64);
            tracing::info!("not a time");
        });
        trace.finish();
        let all = events(&path);
        let find = |name: &str| all.iter().find(|e| e["name"] == name).unwrap_or_else(|| panic!("{name}: {all:?}"));
        let (train, step, sort) = (find("train"), find("step"), find("sort"));
        let span = |e: &serde_json::Value| {
            let at = e["ts"].as_f64().expect("ts");
            (at, at + e["dur"].as_f64().expect("dur"))
        };
        assert!(span(train).0 <= span(step).0 && span(step).1 <= span(train).1);
        assert_eq!((train["tid"] == step["tid"], &sort["tid"], &sort["dur"]), (true, &0.into(), &2.0.into()));
        assert!(span(sort).1 <= span(step).1, "it was over before it was told");
        assert_eq!(all.iter().filter(|e| e["ph"] == "X").count(), 3);
    }

    #[test]
    fn a_trace_stops_at_its_bound_says_so_and_is_still_readable() {
        let dir = tempfile::tempdir().expect("tempdir");
        let path = dir.path().join("trace.json");
        let trace = Trace::bounded(&path, 4096).expect("a file");
        let subscriber = tracing_subscriber::registry().with(trace.clone().layer());
        tracing::subscriber::with_default(subscriber, || {
            (0..1000).for_each(|_| drop(tracing::trace_span!("step").entered()));
        });
        assert!(trace.lock().ended.is_some());
        trace.finish();
        let all = events(&path);
        assert!(all.len() > 20 && all.last().is_some_and(|e| e["name"] == "trace is full"), "{all:?}");
        assert!(path.metadata().expect("its size").len() <= 4096);
    }

    #[test]
    fn a_trace_that_cannot_be_written_is_refused_at_the_start() {
        let refused = Trace::create(Path::new("/nonexistent/trace.json")).expect_err("no such folder");
        assert_eq!(refused.kind(), ErrorKind::Input);
    }
}
