//! Errors in embedded-hal's manner: every error says its [`ErrorKind`], so that generic code can decide (wait, reopen,
//! give up) without knowing who is behind the trait. The one concrete error of the std parts is [`HalError`].

/// What generic code may need to know about an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The other end is gone or the recording is at its end; reopening may help.
    Closed,
    /// Could not be done right now; the same call may succeed later.
    Busy,
    /// A setting, address or file that will never work as given.
    Invalid,
    /// The device or driver refused for another reason.
    Device,
}

/// An error that knows its kind.
pub trait Error: core::fmt::Debug + core::fmt::Display {
    /// The kind of this error.
    fn kind(&self) -> ErrorKind;
}

impl Error for core::convert::Infallible {
    fn kind(&self) -> ErrorKind {
        match *self {}
    }
}

#[cfg(feature = "std")]
pub use with_std::HalError;

#[cfg(feature = "std")]
mod with_std {
    use super::{Error, ErrorKind};
    use std::path::PathBuf;

    /// What can go wrong with links, cameras and settings. One line each: what, where, how to mend.
    #[derive(Debug, thiserror::Error)]
    pub enum HalError {
        /// A link address that does not follow the syntax.
        #[error(
            "link address '{}': {why}; use serial:PATH:BAUD, udpin:HOST:PORT, udpout:HOST:PORT, tcpin:HOST:PORT, tcpout:HOST:PORT, file:LOG.tlog or pty:",
            text.escape_debug()
        )]
        Address {
            /// As given.
            text: String,
            /// What is wrong with it.
            why: &'static str,
        },
        /// A link that could not be opened.
        #[error("cannot open link {address}: {source}{}", remedy(source))]
        Open {
            /// The address.
            address: String,
            /// The system's reason.
            source: std::io::Error,
        },
        /// The other end of a link is gone, or a recording is at its end.
        #[error("link {address} is closed")]
        Closed {
            /// The address.
            address: String,
        },
        /// A link cannot take a frame right now (nobody reads at the other end).
        #[error("link {address} does not take data")]
        Full {
            /// The address.
            address: String,
        },
        /// Reading or writing an open link failed.
        #[error("link {address}: {source}{}", remedy(source))]
        Link {
            /// The address.
            address: String,
            /// The system's reason.
            source: std::io::Error,
        },
        /// The key or time-stamp file of MAVLink signing.
        #[error("signing: {}: {why}", path.display())]
        Signing {
            /// The file.
            path: PathBuf,
            /// What is wrong with it and what would be right.
            why: String,
        },
        /// A camera folder or program that does not work.
        #[error("camera {what}: {why}")]
        Camera {
            /// The folder or command.
            what: String,
            /// What is wrong with it and how to mend it.
            why: String,
        },
        /// A video device that cannot be used, or not now.
        #[error("camera {}: {why}", device.display())]
        Video {
            /// Its path.
            device: PathBuf,
            /// Invalid: it never will as given; busy: another program has it; closed: it was unplugged.
            kind: ErrorKind,
            /// What is wrong and how to mend it.
            why: String,
        },
        /// One picture that could not be used.
        #[error("picture {}: {why}", path.display())]
        Picture {
            /// The file.
            path: PathBuf,
            /// What is wrong with it.
            why: String,
        },
        /// One picture that shows nothing.
        #[error("picture {}: {blank}, left out; check lens cap, exposure and camera", path.display())]
        Blank {
            /// The file.
            path: PathBuf,
            /// What is wrong with its light.
            blank: crate::blank::Blank,
        },
    }

    /// What helps where the system itself refuses a link; words of our own say it themselves.
    fn remedy(source: &std::io::Error) -> &'static str {
        use std::io::ErrorKind as Io;
        match source.kind() {
            Io::NotFound => "; check the path, and whether the device is plugged in",
            Io::PermissionDenied => {
                "; give this user the rights to it: the group dialout for a serial port, a port above 1023"
            }
            Io::AddrInUse | Io::ResourceBusy => "; end the program that uses it, or name another",
            Io::AddrNotAvailable => "; no interface of this machine has that address",
            Io::ConnectionRefused => "; nobody listens there: start what should, or check host and port",
            _ if source.get_ref().is_some() => "",
            _ => "; check cable, power and address",
        }
    }

    impl config::error::Error for HalError {
        fn kind(&self) -> config::error::ErrorKind {
            use config::error::ErrorKind as Kind;
            match self {
                Self::Open { source, .. } => config::error::Error::kind(source),
                Self::Address { .. }
                | Self::Signing { .. }
                | Self::Camera { .. }
                | Self::Video { kind: ErrorKind::Invalid, .. }
                | Self::Picture { .. }
                | Self::Blank { .. } => Kind::Input,
                Self::Video { .. } => Kind::Device,
                Self::Closed { .. } | Self::Full { .. } | Self::Link { .. } => Kind::Failed,
            }
        }
    }

    impl Error for HalError {
        fn kind(&self) -> ErrorKind {
            match self {
                Self::Address { .. } | Self::Signing { .. } => ErrorKind::Invalid,
                // The folder or program may come back.
                Self::Closed { .. } | Self::Camera { .. } => ErrorKind::Closed,
                Self::Full { .. } => ErrorKind::Busy,
                Self::Video { kind, .. } => *kind,
                Self::Open { .. } | Self::Link { .. } | Self::Picture { .. } | Self::Blank { .. } => ErrorKind::Device,
            }
        }
    }
}
