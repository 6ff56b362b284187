//! Why a command did not end well, sorted by what the caller can do about it: that is the exit code.

use std::process::ExitCode;

use models::dataset::DatasetError;
use models::formats::FormatError;

/// One line: what, where, how to mend.
#[derive(Debug, thiserror::Error)]
pub enum CliError {
    /// Usage or input: exit code 2.
    #[error("{0}")]
    Input(String),
    /// No device, driver or library to work with: exit code 3.
    #[error("{0}")]
    Device(String),
    /// Stopped on request; what is saved is valid and can be continued: exit code 4.
    #[error("{0}")]
    Interrupted(String),
    /// Anything else: exit code 1.
    #[error("{0}")]
    Failed(String),
}

impl CliError {
    /// Usage or input.
    pub fn input(what: impl std::fmt::Display) -> Self {
        Self::Input(one_line(what))
    }

    /// No device, driver or library.
    pub fn device(what: impl std::fmt::Display) -> Self {
        Self::Device(one_line(what))
    }

    /// Stopped on request.
    pub fn interrupted(what: impl std::fmt::Display) -> Self {
        Self::Interrupted(one_line(what))
    }

    /// Anything else.
    pub fn failed(what: impl std::fmt::Display) -> Self {
        Self::Failed(one_line(what))
    }

    /// What the process returns.
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Failed(_) => 1,
            Self::Input(_) => 2,
            Self::Device(_) => 3,
            Self::Interrupted(_) => 4,
        })
    }
}

fn one_line(what: impl std::fmt::Display) -> String {
    what.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

impl From<FormatError> for CliError {
    fn from(e: FormatError) -> Self {
        Self::input(e)
    }
}

impl From<DatasetError> for CliError {
    fn from(e: DatasetError) -> Self {
        Self::input(e)
    }
}

impl From<config::plan::PlanError> for CliError {
    fn from(e: config::plan::PlanError) -> Self {
        Self::input(e)
    }
}

impl From<vulkan::gpu::GpuError> for CliError {
    fn from(e: vulkan::gpu::GpuError) -> Self {
        Self::device(e)
    }
}

impl From<vulkan::trainer::TrainError> for CliError {
    fn from(e: vulkan::trainer::TrainError) -> Self {
        match e {
            vulkan::trainer::TrainError::Gpu(e) => e.into(),
            other => Self::input(other),
        }
    }
}

impl From<models::onnx::OnnxError> for CliError {
    fn from(e: models::onnx::OnnxError) -> Self {
        use models::onnx::OnnxError as E;
        match e {
            E::LibraryMissing { .. } | E::Library { .. } => Self::device(e),
            _ => Self::input(e),
        }
    }
}

impl From<models::init::InitError> for CliError {
    fn from(e: models::init::InitError) -> Self {
        match e {
            models::init::InitError::Network(e) => e.into(),
            other => Self::input(other),
        }
    }
}

impl From<models::refine::RefineError> for CliError {
    fn from(e: models::refine::RefineError) -> Self {
        match e {
            models::refine::RefineError::Network(e) => e.into(),
            other => Self::input(other),
        }
    }
}
