//! Ctrl-C and SIGTERM ask for an orderly end; a second one ends at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use config::error::{Error, ErrorKind};
use signal_hook::consts::{SIGINT, SIGTERM};

/// The system refused to install the handlers.
#[derive(Debug, thiserror::Error)]
#[error("signal handlers: {0}")]
pub struct InterruptError(#[from] std::io::Error);

impl Error for InterruptError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Failed
    }
}

/// Whether somebody asked this process to end.
#[derive(Clone, Debug, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Listens from now on.
    ///
    /// # Errors
    /// The system refuses to install the handlers.
    pub fn install() -> Result<Self, InterruptError> {
        let flag = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM] {
            // In this order: the second signal finds the flag set and ends the process; the first only sets it.
            signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&flag))?;
            signal_hook::flag::register(signal, Arc::clone(&flag))?;
        }
        // A user's network may run for minutes.
        models::onnx::session::end_when(Arc::clone(&flag));
        Ok(Self(flag))
    }

    /// True once asked.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Asks, as a signal would.
    pub fn request(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
