//! What a person sees: log lines and progress on standard error — a live bar on a terminal, plain lines otherwise —
//! so that standard output holds results only.

use std::io::{IsTerminal, Write};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

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

/// Sets up logging once per process; a second call changes nothing.
pub fn install(verbose: u8, quiet: bool) {
    let _ = QUIET.set(quiet);
    let level = match (quiet, verbose) {
        (true, _) => "warn",
        (_, 0) => "warn,runtime=info,models=info,vulkan=info,hal=info",
        (_, 1) => "info,runtime=debug,models=debug,vulkan=debug,hal=debug",
        _ => "debug",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(verbose > 0)
        .without_time()
        .with_writer(AroundBars)
        .finish();
    let _ = tracing::subscriber::set_global_default(subscriber);
}

/// One error line on standard error, above any bar.
pub fn error(line: &str) {
    console().bars.suspend(|| eprintln!("dgtr: {line}"));
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
            let _ = std::io::stderr().write_all(&self.0);
        });
    }
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
