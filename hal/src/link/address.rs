//! The address syntax of links: rust-mavlink's and MAVProxy's, so that users can paste what they already have.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use crate::error::HalError;

/// Speed of a serial port when the address gives none: ArduPilot's default for SERIAL1 is 57,600, but a companion
/// computer's port is set to this by its guide.
const DEFAULT_BAUD: u32 = 921_600;

/// Where a link goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkAddress {
    /// `serial:PATH[:BAUD]`
    Serial {
        /// Device, or the far end of a pseudo-terminal.
        path: PathBuf,
        /// Bits per second.
        baud: u32,
    },
    /// `udpin:HOST:PORT`: waits for datagrams, answers the last sender. `udp:` means the same.
    UdpIn(String),
    /// `udpout:HOST:PORT`: sends there first.
    UdpOut(String),
    /// `tcpin:HOST:PORT`: waits for one connection at a time.
    TcpIn(String),
    /// `tcpout:HOST:PORT`: connects. `tcp:` means the same.
    TcpOut(String),
    /// `file:LOG.tlog`: plays a recorded log as fast as it is read.
    File(PathBuf),
    /// `pty:[ALIAS]`: makes a pseudo-terminal; a symbolic link ALIAS points to the far end when given.
    Pty(Option<PathBuf>),
}

impl LinkAddress {
    /// Anybody who reaches this port or host may speak on it: MAVLink is believed unless it is signed.
    pub fn is_shared(&self) -> bool {
        match self {
            Self::UdpIn(host) | Self::UdpOut(host) | Self::TcpIn(host) | Self::TcpOut(host) => {
                let name = host.rsplit_once(':').map_or("", |h| h.0).trim_matches(['[', ']']);
                name != "localhost" && !name.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback())
            }
            Self::Serial { .. } | Self::File(_) | Self::Pty(_) => false,
        }
    }
}

impl FromStr for LinkAddress {
    type Err = HalError;

    fn from_str(text: &str) -> Result<Self, HalError> {
        let wrong = |why| HalError::Address { text: text.into(), why };
        if text == "pty" {
            return Ok(Self::Pty(None));
        }
        let (scheme, rest) = text.split_once(':').ok_or_else(|| wrong("no scheme before ':'"))?;
        let host = || {
            let port = rest.rsplit_once(':').ok_or_else(|| wrong("the port is missing"))?.1;
            match port.parse::<u16>() {
                Ok(_) => Ok(rest.to_string()),
                Err(_) => Err(wrong("the port is not a number up to 65535")),
            }
        };
        let path = || if rest.is_empty() { Err(wrong("the path is missing")) } else { Ok(PathBuf::from(rest)) };
        match scheme {
            "serial" => {
                let (path, baud) = match rest.rsplit_once(':') {
                    Some((path, baud)) => {
                        (path, baud.parse().map_err(|_| wrong("the baud rate after the last ':' is not a number"))?)
                    }
                    None => (rest, DEFAULT_BAUD),
                };
                if path.is_empty() || baud == 0 {
                    return Err(wrong("the path is missing or the baud rate is 0"));
                }
                Ok(Self::Serial { path: path.into(), baud })
            }
            "udpin" | "udp" => host().map(Self::UdpIn),
            "udpout" => host().map(Self::UdpOut),
            "tcpin" => host().map(Self::TcpIn),
            "tcpout" | "tcp" => host().map(Self::TcpOut),
            "file" => path().map(Self::File),
            "pty" => Ok(Self::Pty((!rest.is_empty()).then(|| rest.into()))),
            _ => Err(wrong("unknown scheme")),
        }
    }
}

impl fmt::Display for LinkAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Serial { path, baud } => write!(f, "serial:{}:{baud}", path.display()),
            Self::UdpIn(host) => write!(f, "udpin:{host}"),
            Self::UdpOut(host) => write!(f, "udpout:{host}"),
            Self::TcpIn(host) => write!(f, "tcpin:{host}"),
            Self::TcpOut(host) => write!(f, "tcpout:{host}"),
            Self::File(path) => write!(f, "file:{}", path.display()),
            Self::Pty(None) => write!(f, "pty:"),
            Self::Pty(Some(alias)) => write!(f, "pty:{}", alias.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_address_survives_a_round_trip() {
        for text in [
            "serial:/dev/ttyAMA0:921600",
            "udpin:0.0.0.0:14550",
            "udpout:[::1]:14550",
            "tcpin:127.0.0.1:5760",
            "tcpout:localhost:5760",
            "file:logs/a.tlog",
            "pty:",
            "pty:/tmp/autopilot",
        ] {
            assert_eq!(text.parse::<LinkAddress>().expect(text).to_string(), text);
        }
        assert_eq!("pty".parse::<LinkAddress>().expect("short form"), LinkAddress::Pty(None));
    }

    #[test]
    fn wrong_addresses_say_what_is_wrong_and_what_would_be_right() {
        for (text, why) in [
            ("/dev/ttyS0", "scheme"),
            ("serail:/dev/ttyS0:1", "unknown scheme"),
            ("serial:/dev/ttyS0:fast", "baud"),
            ("udpin:0.0.0.0", "port"),
            ("tcpout:host:99999", "65535"),
            ("file:", "path"),
        ] {
            let message = text.parse::<LinkAddress>().expect_err(text).to_string();
            assert!(message.contains(why) && message.contains("udpin:HOST:PORT"), "{message}");
        }
    }

    #[test]
    fn only_links_that_others_can_reach_are_shared() {
        let shared = |text: &str| text.parse::<LinkAddress>().expect(text).is_shared();
        assert!(["udpin:0.0.0.0:14550", "tcpin:[::]:5760", "udpout:10.0.0.2:14550"].into_iter().all(shared));
        let own = ["udpin:127.0.0.1:14550", "tcpout:localhost:5760", "tcpin:[::1]:5760", "serial:/dev/ttyAMA0", "pty"];
        assert!(!own.into_iter().any(shared));
    }
}
