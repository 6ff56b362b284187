//! What every error of the project says about itself: its [`ErrorKind`], by which a program decides what to do about it
//! (`dgtr` turns it into its exit code) without knowing which library failed.

/// What the caller can do about an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ErrorKind {
    /// None of the others: the disk, another process, the system.
    Failed,
    /// Usage, a setting, a file or an address of the user's; it will never work as given.
    Input,
    /// A device, driver or library is missing or refuses.
    Device,
    /// Stopped on request or by a time limit; what is saved is valid and can be continued.
    Interrupted,
    /// Done, but of less than half of what was given.
    Partial,
}

impl ErrorKind {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Failed, Self::Input, Self::Device, Self::Interrupted, Self::Partial];
}

/// An error that knows its kind. Its text is one line: what, where, how to mend.
pub trait Error: core::error::Error {
    /// The kind of this error.
    fn kind(&self) -> ErrorKind;
}

#[cfg(feature = "std")]
impl Error for std::io::Error {
    /// A path that is wrong or closed to the user is their input; a full disk or a failing one is not.
    fn kind(&self) -> ErrorKind {
        use std::io::ErrorKind as Io;
        match Self::kind(self) {
            Io::NotFound
            | Io::PermissionDenied
            | Io::AlreadyExists
            | Io::NotADirectory
            | Io::IsADirectory
            | Io::InvalidInput
            | Io::InvalidData
            | Io::InvalidFilename
            | Io::AddrNotAvailable => ErrorKind::Input,
            _ => ErrorKind::Failed,
        }
    }
}

/// What this crate refuses is always something that the user wrote.
#[cfg(feature = "std")]
macro_rules! input {
    ($($error:ty),*) => {$(
        impl Error for $error {
            fn kind(&self) -> ErrorKind {
                ErrorKind::Input
            }
        }
    )*};
}

#[cfg(feature = "std")]
input!(
    crate::kernels::KernelChoiceError,
    crate::mission::MissionError,
    crate::plan::PlanError,
    crate::settings::SettingError,
    crate::settings::SyntaxError
);

#[cfg(all(test, feature = "std"))]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_path_is_input_and_a_full_disk_is_not() {
        use std::io::{Error as IoError, ErrorKind as Io};
        for (io, kind) in [
            (Io::NotFound, ErrorKind::Input),
            (Io::PermissionDenied, ErrorKind::Input),
            (Io::StorageFull, ErrorKind::Failed),
            (Io::ConnectionRefused, ErrorKind::Failed),
        ] {
            assert_eq!(Error::kind(&IoError::from(io)), kind, "{io:?}");
        }
    }
}
