//! `[upload]` of the mission file: how models travel from the aircraft to the ground.
//!
//! One section serves both ends, because both read the same mission file: the aircraft connects to `connect`,
//! the ground listens on `listen`, and either may use `folder` (a USB stick carried over after landing, or a
//! shared directory) as well or instead. With neither, models simply stay on the aircraft.

use std::path::PathBuf;

use crate::settings::{Limits, SettingError, choice, record, table};

/// Smallest and largest chunk, KiB. The upper end keeps one lost reply cheap to repeat; the lower one keeps the
/// list of chunk hashes of a full-size model below [`UploadSettings::max_chunks`].
pub const CHUNK_KIB: std::ops::RangeInclusive<u32> = 16..=1024;

choice! {
    /// What is sent of a model.
    pub enum Encoding {
        /// The file as it was trained, 236 bytes per Gaussian of SH degree 3.
        Exact = "exact",
        /// Rounded and entropy-coded, about a thirtieth of that (`models/FORMATS.md`); 1.1 kB of `memory.host_mib` per
        /// Gaussian are planned for the encoding.
        Delivery = "delivery",
        /// Quantised more finely than `delivery`, for what is seen from near: a third more bytes than `delivery`.
        Fine = "fine",
    }
}

table! {
    /// How models travel from the aircraft to the ground.
    pub struct UploadSettings {
        /// What is sent of a model.
        pub encoding: Encoding = Encoding::Exact;
        /// A directory both ends can reach, at the same or at different times; absent = not used.
        pub folder: Option<PathBuf> = None;
        /// Where the aircraft finds the ground, zenoh endpoints such as `tls/10.0.0.2:7447`; `tcp/` on this machine only.
        pub connect: Vec<String> = Vec::new();
        /// Where the ground listens, such as `tls/0.0.0.0:7447`; empty = not used.
        pub listen: Vec<String> = Vec::new();
        /// Certificates of your own authority for `tls/` endpoints; absent = those that the mission's keys make.
        pub tls: Option<TlsSettings> = None;
        /// Folder of this end's private key, `ID.key` of an aircraft or `ground.key`. What counts flights and models lies there, too,
        /// where there is no state folder (`STATE_DIRECTORY`).
        pub keys: PathBuf = PathBuf::from("keys");
        /// The ground takes models that an earlier session has received, too, as `dgtr serve --again` does.
        pub again: bool = false;
        /// A word for this day's flights, such as `"2026-11-29"`: the ground takes models made under the same word only. Absent = the
        /// ground draws a number and tells the aircraft over the network or on the stick.
        pub session: Option<String> = None;
        /// Endpoints beyond this machine are used although nothing is signed (anybody there can replace any model) or encrypted
        /// (anybody there can read it, and slow down what is sent).
        pub insecure: bool = false;
        /// Bound on what an aircraft sends; absent = what the link carries.
        pub max_kib_s: Option<u32> = None, in Limits::at_least(1.0), unit "KiB/s";
        /// Least time between two checkpoints on offer; 0 = only the final model is offered. Stretched on a slow link, so that
        /// checkpoints take a quarter of it at most.
        pub checkpoint_s: f64 = 60.0, in Limits::within(0.0, 86_400.0);
        /// Size of a chunk.
        pub chunk_kib: u32 = 1024, in Limits::within(*CHUNK_KIB.start() as f64, *CHUNK_KIB.end() as f64);
        /// Largest model the ground accepts; 1 M Gaussians of SH degree 3 are 225 MiB.
        pub max_model_mib: u32 = 1024, in Limits::within(1.0, 16_384.0);
        /// First pause after a failed attempt; doubles with every further failure.
        pub retry_min_s: f64 = 0.5, in Limits::above(0.0).up_to(3600.0);
        /// Longest pause between attempts.
        pub retry_max_s: f64 = 30.0, in Limits::above(0.0).up_to(3600.0);
        /// How long the ground waits for one chunk.
        pub chunk_timeout_s: f64 = 20.0, in Limits::above(0.0).up_to(3600.0);
        /// How often the ground asks for new offers.
        pub poll_s: f64 = 2.0, in Limits::above(0.0).up_to(3600.0);
    } where Self::agrees
}

record! {
    /// Certificates of one end, PEM files. Client certificates are always asked for, and the common name of an aircraft's
    /// is its id: the ground takes nothing under another aircraft's name from it.
    #[derive(Eq)]
    pub struct TlsSettings {
        /// Certificate authority that signed both ends.
        pub authority: PathBuf;
        /// This end's certificate.
        pub certificate: PathBuf;
        /// This end's private key; a file that others may read is refused.
        pub key: PathBuf;
    }
}

impl UploadSettings {
    /// Bytes of one chunk (the last one of a model may be shorter). Under `max_kib_s` no larger than what passes in a quarter
    /// of `chunk_timeout_s`.
    pub fn chunk_bytes(&self) -> u32 {
        let passes = self.max_kib_s.map_or(u32::MAX, |kib| (f64::from(kib) * self.chunk_timeout_s / 4.0) as u32);
        self.chunk_kib.min(passes).clamp(*CHUNK_KIB.start(), *CHUNK_KIB.end()) * 1024
    }

    /// The first endpoint that is not on this machine itself, with its setting; anybody who reaches it can speak.
    pub fn exposed(&self) -> Option<(&'static str, &str)> {
        let connect = self.connect.iter().map(|e| ("connect", e.as_str()));
        let listen = self.listen.iter().map(|e| ("listen", e.as_str()));
        connect.chain(listen).find(|(_, e)| !is_loopback(e))
    }

    /// Whether endpoints are encrypted; all are, or none.
    pub fn has_tls(&self) -> bool {
        self.connect.iter().chain(&self.listen).any(|e| e.starts_with("tls/"))
    }

    /// Largest model accepted, bytes.
    pub fn max_model_bytes(&self) -> u64 {
        u64::from(self.max_model_mib) << 20
    }

    /// Most chunks a model of the largest size may be cut into by any sender: twice as many as its bytes say, for the cells that end
    /// before a chunk does.
    pub fn max_chunks(&self) -> u64 {
        2 * self.max_model_bytes().div_ceil(u64::from(*CHUNK_KIB.start()) * 1024)
    }

    /// UDP lost replies without a word when measured, QUIC and others are not built in; encryption is all or nothing.
    fn agrees(&self) -> Result<(), SettingError> {
        for (field, endpoints) in [("connect", &self.connect), ("listen", &self.listen)] {
            for endpoint in endpoints {
                let wanted = match (endpoint.split_once('/'), &self.tls) {
                    (Some(("tcp", _)), None) if self.has_tls() => "encrypted as another one is: write tls/HOST:PORT",
                    (Some(("tcp", at)), None) | (Some(("tls", at)), _) if at.contains(':') => continue,
                    (Some(("tcp", _)), Some(_)) => {
                        "encrypted as [upload.tls] is set: write tls/HOST:PORT or drop [upload.tls]"
                    }
                    _ => "TCP or TLS: write tcp/HOST:PORT or tls/HOST:PORT",
                };
                return Err(SettingError::new(field, endpoint, wanted));
            }
        }
        if self.retry_min_s > self.retry_max_s {
            return Err(SettingError::new("retry_min_s", &self.retry_min_s, "at most retry_max_s"));
        }
        Ok(())
    }
}

/// Whether `PROTOCOL/HOST:PORT` stays on this machine. An endpoint with options behind `?` or `#` may be bound elsewhere.
fn is_loopback(endpoint: &str) -> bool {
    let address = endpoint.split_once('/').map_or(endpoint, |e| e.1);
    let host = address.rsplit_once(':').map_or(address, |a| a.0);
    let host = host.strip_prefix('[').and_then(|h| h.strip_suffix(']')).unwrap_or(host);
    let plain = !address.contains(['?', '#']);
    plain && (host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_addresses_of_this_machine_are_not_exposed() {
        let exposed = |endpoint: &str| {
            let s = UploadSettings { listen: vec![endpoint.into()], ..Default::default() };
            s.exposed().is_some()
        };
        for inside in ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tls/localhost:7447", "tcp/127.8.9.1:1"] {
            assert!(!exposed(inside), "{inside}");
        }
        for outside in [
            "tcp/0.0.0.0:7447",
            "tcp/[::]:7447",
            "tls/10.0.0.2:7447",
            "tcp/ground.local:7447",
            "tcp/127.0.0.1.example.org:7447",
            "tcp/127.0.0.1:7447#iface=wlan0",
        ] {
            assert!(exposed(outside), "{outside}");
        }
    }

    #[test]
    fn under_a_bandwidth_cap_a_chunk_passes_well_before_its_timeout() {
        let s = UploadSettings { max_kib_s: Some(20), ..Default::default() };
        assert_eq!(s.chunk_bytes(), 100 * 1024);
        assert_eq!(UploadSettings { max_kib_s: Some(1), ..s }.chunk_bytes(), 16 * 1024);
        assert_eq!(UploadSettings::default().chunk_bytes(), 1024 * 1024);
        assert!(UploadSettings { max_kib_s: Some(0), ..Default::default() }.check().is_err());
        assert!(UploadSettings { checkpoint_s: f64::NAN, ..Default::default() }.check().is_err());
    }

    #[test]
    fn udp_endpoints_are_refused() {
        let s = UploadSettings { connect: vec!["udp/1.2.3.4:7447".into()], ..Default::default() };
        let refused = s.check().expect_err("udp");
        assert_eq!((refused.field.as_str(), refused.value.as_str()), ("connect", "\"udp/1.2.3.4:7447\""));
        assert!(refused.wanted.contains("tcp/HOST:PORT"));
    }

    #[test]
    fn encryption_is_all_or_nothing() {
        let tls = TlsSettings { authority: "ca.pem".into(), certificate: "c.pem".into(), key: "k.pem".into() };
        let plain =
            UploadSettings { listen: vec!["tcp/0.0.0.0:7447".into()], tls: Some(tls.clone()), ..Default::default() };
        assert!(plain.check().is_err_and(|e| e.field == "listen" && e.wanted.contains("encrypted")));
        let bare = UploadSettings { listen: vec!["tls/0.0.0.0:7447".into()], ..Default::default() };
        assert_eq!(bare.check(), Ok(()), "the mission's keys make the certificates");
        let mixed = UploadSettings { connect: vec!["tcp/127.0.0.1:7447".into()], ..bare.clone() };
        assert!(mixed.check().is_err_and(|e| e.field == "connect" && e.wanted.contains("tls/HOST:PORT")));
        assert_eq!(UploadSettings { tls: Some(tls), ..bare }.check(), Ok(()));
    }

    #[test]
    fn defaults_are_valid_and_unknown_keys_are_not() {
        assert_eq!(UploadSettings::default().check(), Ok(()));
        assert_eq!(toml::from_str::<UploadSettings>("").ok(), Some(UploadSettings::default()));
        assert!(toml::from_str::<UploadSettings>("conect = []").is_err());
        assert!(toml::from_str::<UploadSettings>("retry_min_s = 99.0").is_ok_and(|s| s.check().is_err()));
    }
}
