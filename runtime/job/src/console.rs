//! What a person sees: log lines and progress on standard error — a live bar on a terminal, plain lines otherwise —
//! so that standard output holds results only. Or one JSON object a line, for programs.

use std::collections::VecDeque;
use std::io::{IsTerminal, Write};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use tracing::Level;
use tracing::field::{Field, Visit};
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::time::{FormatTime, SystemTime};
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::{EnvFilter, Layer};

use crate::CRATES;
use crate::trace::{Trace, is_ours};

/// Between two plain progress lines.
const LINE_EVERY: Duration = Duration::from_secs(5);

struct Console {
    bars: MultiProgress,
    live: bool,
    quiet: bool,
}

fn console() -> &'static Console {
    static CONSOLE: OnceLock<Console> = OnceLock::new();
    CONSOLE.get_or_init(|| Console {
        bars: MultiProgress::new(),
        live: std::io::stderr().is_terminal(),
        quiet: QUIET.get().copied().unwrap_or(false),
    })
}

static QUIET: OnceLock<bool> = OnceLock::new();
static FORMAT: OnceLock<Format> = OnceLock::new();

/// How log lines are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// For people.
    #[default]
    Text,
    /// One object a line.
    Json,
}

/// Sets up logging once per process, and the trace if there is to be one; a second call changes nothing.
pub fn install(verbose: u8, quiet: bool, format: Format, trace: Option<Trace>) {
    // Bars are for people.
    let _ = QUIET.set(quiet || format == Format::Json);
    let _ = FORMAT.set(format);
    let (others, ours) = match (quiet, verbose) {
        (true, _) => ("warn", "warn"),
        (_, 0) => ("warn", "info"),
        (_, 1) => ("info", "debug"),
        _ => ("debug", "debug"),
    };
    let level = CRATES.iter().fold(others.to_owned(), |all, name| format!("{all},{name}={ours}"));
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let lines = tracing_subscriber::fmt::layer().with_writer(AroundBars);
    let lines = match format {
        Format::Text => {
            let ansi = std::io::stderr().is_terminal();
            lines.with_ansi(ansi).with_target(verbose > 0).without_time().boxed()
        }
        Format::Json => lines.json().flatten_event(true).with_current_span(true).with_span_list(false).boxed(),
    };
    let subscriber = tracing_subscriber::registry()
        .with(lines.with_filter(filter))
        .with(Warnings.with_filter(filter_fn(|m| *m.level() <= Level::WARN && is_ours(m))))
        .with(trace.map(Trace::layer));
    let _ = tracing::subscriber::set_global_default(subscriber);
}

/// One error line on standard error, above any bar.
pub fn error(line: &str) {
    let line = &said(line);
    let line = match FORMAT.get() {
        Some(Format::Json) => {
            let mut time = String::new();
            // Without a clock the line is still worth having.
            let _ = SystemTime.format_time(&mut Writer::new(&mut time));
            let fields = serde_json::json!({ "timestamp": time, "level": "ERROR", "message": line, "target": "dgtr" });
            fields.to_string()
        }
        _ => format!("dgtr: {line}"),
    };
    // A log line that cannot be written has nowhere to be reported.
    drop(Line(line.into_bytes()));
}

/// An error as a line that people can read. What names within it would make a terminal do is written out. Of a line that is longer than
/// a screen the middle is left out: its end is the remedy.
fn said(line: &str) -> String {
    let line = disk::escaped(line);
    let (all, end) = (line.chars().count(), LONGEST / 4);
    if all <= LONGEST {
        return line;
    }
    let part = |from: usize, count: usize| line.chars().skip(from).take(count).collect::<String>();
    format!("{} … {}", part(0, LONGEST - end), part(all - end, end))
}

/// Characters of an error's line.
const LONGEST: usize = 4096;

/// Warnings that are kept for the page, and characters of each.
const KEPT: usize = 24;
const CHARACTERS: usize = 240;

/// The last warnings, oldest first, with how often each was said in a row.
static KEPT_WARNINGS: Mutex<VecDeque<(String, u32)>> = Mutex::new(VecDeque::new());

/// The log's last warnings and errors, for the page.
pub fn warnings() -> Vec<String> {
    let kept = KEPT_WARNINGS.lock().unwrap_or_else(PoisonError::into_inner);
    let line =
        |(text, times): &(String, u32)| if *times > 1 { format!("{text} ({times} times)") } else { text.clone() };
    kept.iter().map(line).collect()
}

fn keep(text: String) {
    let mut kept = KEPT_WARNINGS.lock().unwrap_or_else(PoisonError::into_inner);
    match kept.back_mut().filter(|last| last.0 == text) {
        Some(last) => last.1 = last.1.saturating_add(1),
        None => {
            if kept.len() == KEPT {
                kept.pop_front();
            }
            kept.push_back((text, 1));
        }
    }
}

/// Keeps warnings and errors of the log.
struct Warnings;

impl<S: tracing::Subscriber> Layer<S> for Warnings {
    fn on_event(&self, event: &tracing::Event<'_>, _: Context<'_, S>) {
        struct Message(String);
        impl Visit for Message {
            fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
                if field.name() == "message" {
                    self.0 = format!("{value:?}").chars().take(CHARACTERS).collect();
                }
            }
        }
        let mut message = Message(String::new());
        event.record(&mut message);
        keep(message.0);
    }
}

/// Writes to standard error without tearing a live bar.
struct AroundBars;

impl<'a> MakeWriter<'a> for AroundBars {
    type Writer = Line;

    fn make_writer(&'a self) -> Line {
        Line(Vec::new())
    }
}

struct Line(Vec<u8>);

impl Write for Line {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        // A log line that cannot be written has nowhere to be reported.
        console().bars.suspend(|| {
            let _ = std::io::stderr().write_all(&one_line(&self.0));
        });
    }
}

/// An event as one line: a line end in the name of a file would begin another, which nobody logged.
fn one_line(event: &[u8]) -> Vec<u8> {
    let mut line = Vec::with_capacity(event.len());
    for byte in event.strip_suffix(b"\n").unwrap_or(event) {
        match byte {
            b'\n' => line.extend(b"\\n"),
            b'\r' => line.extend(b"\\r"),
            _ => line.push(*byte),
        }
    }
    line.push(b'\n');
    line
}

/// Progress of one long stage.
pub struct Progress {
    bar: Option<ProgressBar>,
    label: String,
    total: u64,
    last: Instant,
    quiet: bool,
}

impl Progress {
    /// Starts a stage of `total` units.
    pub fn new(label: &str, total: u64) -> Self {
        let c = console();
        let bar = (c.live && !c.quiet).then(|| {
            let bar = c.bars.add(ProgressBar::new(total));
            if let Ok(style) = ProgressStyle::with_template("{prefix:>12} {wide_bar} {pos}/{len} {msg} {eta}") {
                bar.set_style(style);
            }
            bar.set_prefix(label.to_owned());
            bar
        });
        Self { bar, label: label.to_owned(), total, last: Instant::now(), quiet: c.quiet }
    }

    /// Reports that `done` units are done, with a few words; cheap enough for every step.
    pub fn set(&mut self, done: u64, words: impl FnOnce() -> String) {
        if self.quiet || self.last.elapsed() < if self.bar.is_some() { Duration::from_millis(100) } else { LINE_EVERY }
        {
            return;
        }
        self.last = Instant::now();
        match &self.bar {
            Some(bar) => {
                bar.set_position(done);
                bar.set_message(words());
            }
            None => tracing::info!("{} {done}/{}: {}", self.label, self.total, words()),
        }
    }

    /// Ends the stage with a line that stays.
    pub fn finish(self, words: &str) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        tracing::info!("{}: {words}", self.label);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_end_in_a_name_forges_no_log_line() {
        assert_eq!(one_line(b" INFO key frame 1: a\nINFO forged\r\n\n"), b" INFO key frame 1: a\\nINFO forged\\r\\n\n");
        assert_eq!(one_line(b" INFO plain\n"), b" INFO plain\n");
    }

    #[test]
    fn an_error_is_one_line_of_a_screens_length_with_nothing_that_a_terminal_obeys() {
        assert_eq!(said("a\u{1b}[2J\nINFO b.toml: check the path"), "a\\u001b[2J\\nINFO b.toml: check the path");
        let long = said(&format!("name = \"{}\": must be short", "\u{e9}".repeat(1 << 20)));
        assert_eq!(long.chars().count(), LONGEST + 3);
        assert!(long.starts_with("name = \"\u{e9}") && long.ends_with("\": must be short"), "{long}");
    }

    #[test]
    fn the_last_warnings_are_kept_and_repeated_ones_are_counted() {
        (0..3 * KEPT).for_each(|i| keep(format!("{i}")));
        (0..3).for_each(|_| keep("again".into()));
        let kept = warnings();
        assert_eq!((kept.len(), kept[KEPT - 1].as_str()), (KEPT, "again (3 times)"));
        assert_eq!(kept[KEPT - 2], format!("{}", 3 * KEPT - 1));
    }
}
