//! Why a command did not end well, and the exit codes that scripts may rely on.

use std::process::ExitCode;

use config::error::{Error, ErrorKind};

/// What the process returns for an error of each kind (0 is a job that is done). The one place that knows.
pub const EXIT_CODES: [(ErrorKind, u8, &str); 5] = [
    (ErrorKind::Failed, 1, "failed"),
    (ErrorKind::Input, 2, "usage or bad input"),
    (ErrorKind::Device, 3, "device, driver or library missing"),
    (ErrorKind::Interrupted, 4, "interrupted with a valid checkpoint"),
    (ErrorKind::Partial, 5, "done, but fewer than half of the pictures could be used"),
];

/// The exit code of an error of this kind.
pub fn exit_code(kind: ErrorKind) -> ExitCode {
    ExitCode::from(code_of(kind))
}

/// The exit code of an error of this kind, as a number.
pub(super) fn code_of(kind: ErrorKind) -> u8 {
    EXIT_CODES.iter().find(|row| row.0 == kind).map_or(1, |row| row.1)
}

/// One line (what, where, how to mend) and its kind.
#[derive(Debug, thiserror::Error)]
#[error("{line}")]
pub struct CliError {
    kind: ErrorKind,
    line: String,
}

impl CliError {
    /// An error of the command line itself, or another's error in its words.
    pub fn new(kind: ErrorKind, what: impl std::fmt::Display) -> Self {
        Self { kind, line: what.to_string().split_whitespace().collect::<Vec<_>>().join(" ") }
    }

    /// Usage or input.
    pub fn input(what: impl std::fmt::Display) -> Self {
        Self::new(ErrorKind::Input, what)
    }

    /// Stopped on request.
    pub fn interrupted(what: impl std::fmt::Display) -> Self {
        Self::new(ErrorKind::Interrupted, what)
    }

    /// Anything else.
    pub fn failed(what: impl std::fmt::Display) -> Self {
        Self::new(ErrorKind::Failed, what)
    }

    /// What the process returns.
    pub fn exit_code(&self) -> ExitCode {
        exit_code(self.kind)
    }
}

impl<E: Error> From<E> for CliError {
    fn from(e: E) -> Self {
        Self::new(e.kind(), e)
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Error as IoError, ErrorKind as Io};

    use config::plan::{Plan, PlanRequest};
    use hal::error::HalError;
    use models::formats::FormatError;
    use models::init::InitError;
    use models::onnx::OnnxError;
    use models::refine::RefineError;
    use vulkan::gpu::GpuError;
    use vulkan::trainer::TrainError;

    use super::*;
    use crate::error::JobError;
    use ground::AggregateError;
    use ground::jobs::serve::ServeError;
    use uplink::UploadError;

    #[test]
    fn every_kind_has_one_row_and_the_documented_code() {
        assert_eq!(EXIT_CODES.map(|row| row.0), ErrorKind::ALL);
        assert_eq!(EXIT_CODES.map(|row| row.1), [1, 2, 3, 4, 5]);
        let readme = include_str!("../../../README.md").split_whitespace().collect::<Vec<_>>().join(" ");
        for (kind, code, meaning) in EXIT_CODES {
            assert_eq!(exit_code(kind), ExitCode::from(code));
            assert!(
                readme.contains(&format!("{code} {}", meaning.split(" or").next().unwrap_or(meaning))),
                "{meaning}"
            );
        }
    }

    fn lost() -> GpuError {
        GpuError::DeviceLost { during: "vkQueueSubmit" }
    }

    fn no_library() -> OnnxError {
        OnnxError::LibraryMissing { searched: "nowhere".into() }
    }

    fn io(kind: Io) -> FormatError {
        FormatError::Io { path: "x".into(), action: "writing", source: IoError::from(kind) }
    }

    /// One cause has one code, whichever job met it.
    #[test]
    fn an_error_keeps_its_kind_through_every_job() {
        use ErrorKind::{Device, Failed, Input, Interrupted};
        let open = |kind| HalError::Open { address: "serial:x".into(), source: IoError::from(kind) };
        let closed = || HalError::Closed { address: "udpin:x".into() };
        let plan = || Plan::new(&PlanRequest { device_mib: 1, ..PlanRequest::default() }).unwrap_err();
        let cases: [(CliError, ErrorKind); 16] = [
            (lost().into(), Device),
            (TrainError::from(lost()).into(), Device),
            (JobError::from(TrainError::from(lost())).into(), Device),
            (AggregateError::from(TrainError::from(lost())).into(), Device),
            (ServeError::from(AggregateError::from(TrainError::from(lost()))).into(), Device),
            (JobError::from(RefineError::from(no_library())).into(), Device),
            (JobError::from(InitError::from(no_library())).into(), Device),
            (JobError::from(RefineError::Duplicate("x".into())).into(), Input),
            (JobError::from(plan()).into(), Input),
            (AggregateError::from(plan()).into(), Input),
            (JobError::from(open(Io::NotFound)).into(), Input),
            (JobError::from(open(Io::AddrInUse)).into(), Failed),
            (JobError::from(closed()).into(), Failed),
            (JobError::from(io(Io::StorageFull)).into(), Failed),
            (ServeError::from(UploadError::NoTransport("connect")).into(), Input),
            (ServeError::Nothing("mission".into()).into(), Interrupted),
        ];
        for (error, kind) in cases {
            assert_eq!(error.kind, kind, "{error}");
        }
    }
}
