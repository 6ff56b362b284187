//! `[upload]` of the mission file: how models travel from the aircraft to the ground.
//!
//! One section serves both ends, because both read the same mission file: the aircraft connects to `connect`,
//! the ground listens on `listen`, and either may use `folder` (a USB stick carried over after landing, or a
//! shared directory) as well or instead. With neither, models simply stay on the aircraft.

use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Smallest and largest chunk, KiB. The upper end keeps one lost reply cheap to repeat; the lower one keeps the
/// list of chunk hashes of a full-size model below [`UploadSettings::max_chunks`].
pub const CHUNK_KIB: std::ops::RangeInclusive<u32> = 16..=1024;

/// `[upload]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct UploadSettings {
    /// A directory both ends can reach, at the same or at different times. None = not used.
    pub folder: Option<PathBuf>,
    /// Where the aircraft finds the ground, zenoh endpoints such as `tcp/10.0.0.2:7447` or `tls/ground.local:7447`.
    pub connect: Vec<String>,
    /// Where the ground listens, such as `tcp/0.0.0.0:7447`. Empty = not used.
    pub listen: Vec<String>,
    /// Certificates; required for `tls/` endpoints.
    pub tls: Option<TlsSettings>,
    /// Size of a chunk, KiB, within [`CHUNK_KIB`].
    pub chunk_kib: u32,
    /// Largest model the ground accepts, MiB. 1 M Gaussians of SH degree 3 are 225 MiB.
    pub max_model_mib: u32,
    /// First pause after a failed attempt, seconds; doubles with every further failure.
    pub retry_min_s: f64,
    /// Longest pause between attempts, seconds.
    pub retry_max_s: f64,
    /// How long the ground waits for one chunk, seconds.
    pub chunk_timeout_s: f64,
    /// How often the ground asks for new offers, seconds.
    pub poll_s: f64,
}

impl Default for UploadSettings {
    fn default() -> Self {
        Self {
            folder: None,
            connect: Vec::new(),
            listen: Vec::new(),
            tls: None,
            chunk_kib: 1024,
            max_model_mib: 1024,
            retry_min_s: 0.5,
            retry_max_s: 30.0,
            chunk_timeout_s: 20.0,
            poll_s: 2.0,
        }
    }
}

/// Certificates of one end, PEM files. Client certificates are always asked for: an aircraft the ground does not
/// know cannot offer anything.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsSettings {
    /// Certificate authority that signed both ends.
    pub authority: PathBuf,
    /// This end's certificate.
    pub certificate: PathBuf,
    /// This end's private key.
    pub key: PathBuf,
}

/// What is wrong with `[upload]`.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum UploadSettingsError {
    /// UDP lost replies without a word when measured; QUIC and others are not built in.
    #[error("endpoint \"{0}\" is not TCP or TLS; write tcp/HOST:PORT or tls/HOST:PORT")]
    Endpoint(String),
    /// A `tls/` endpoint without certificates.
    #[error("endpoint \"{0}\" needs [upload.tls] with authority, certificate and key")]
    NoCertificates(String),
    /// Certificates given, but an endpoint would go around them.
    #[error("endpoint \"{0}\" is not encrypted although [upload.tls] is set; write tls/HOST:PORT or drop [upload.tls]")]
    Unencrypted(String),
    /// A number outside its range.
    #[error("{0}")]
    Range(String),
}

impl UploadSettings {
    /// Bytes of one chunk (the last one of a model may be shorter).
    pub fn chunk_bytes(&self) -> u32 {
        self.chunk_kib.clamp(*CHUNK_KIB.start(), *CHUNK_KIB.end()) * 1024
    }

    /// Largest model accepted, bytes.
    pub fn max_model_bytes(&self) -> u64 {
        u64::from(self.max_model_mib) << 20
    }

    /// Most chunks a model of the largest size may be cut into by any sender.
    pub fn max_chunks(&self) -> u64 {
        self.max_model_bytes().div_ceil(u64::from(*CHUNK_KIB.start()) * 1024)
    }

    /// Checks what serde cannot.
    pub fn validate(&self) -> Result<(), UploadSettingsError> {
        for endpoint in self.connect.iter().chain(&self.listen) {
            match endpoint.split_once('/') {
                Some(("tcp", rest)) if rest.contains(':') => {
                    if self.tls.is_some() {
                        return Err(UploadSettingsError::Unencrypted(endpoint.clone()));
                    }
                }
                Some(("tls", rest)) if rest.contains(':') => {
                    if self.tls.is_none() {
                        return Err(UploadSettingsError::NoCertificates(endpoint.clone()));
                    }
                }
                _ => return Err(UploadSettingsError::Endpoint(endpoint.clone())),
            }
        }
        let range = |what: String| Err(UploadSettingsError::Range(what));
        if !CHUNK_KIB.contains(&self.chunk_kib) {
            return range(format!(
                "chunk_kib {} is outside {}..={}",
                self.chunk_kib,
                CHUNK_KIB.start(),
                CHUNK_KIB.end()
            ));
        }
        if !(1..=16 * 1024).contains(&self.max_model_mib) {
            return range(format!("max_model_mib {} is outside 1..=16384", self.max_model_mib));
        }
        for (name, value) in [
            ("retry_min_s", self.retry_min_s),
            ("retry_max_s", self.retry_max_s),
            ("chunk_timeout_s", self.chunk_timeout_s),
            ("poll_s", self.poll_s),
        ] {
            if !(value > 0.0 && value <= 3600.0) {
                return range(format!("{name} {value} is outside 0 < s <= 3600"));
            }
        }
        if self.retry_min_s > self.retry_max_s {
            return range(format!("retry_min_s {} is above retry_max_s {}", self.retry_min_s, self.retry_max_s));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn udp_endpoints_are_refused() {
        let s = UploadSettings { connect: vec!["udp/1.2.3.4:7447".into()], ..Default::default() };
        assert_eq!(s.validate(), Err(UploadSettingsError::Endpoint("udp/1.2.3.4:7447".into())));
    }

    #[test]
    fn encryption_is_all_or_nothing() {
        let tls = TlsSettings { authority: "ca.pem".into(), certificate: "c.pem".into(), key: "k.pem".into() };
        let plain =
            UploadSettings { listen: vec!["tcp/0.0.0.0:7447".into()], tls: Some(tls.clone()), ..Default::default() };
        assert!(matches!(plain.validate(), Err(UploadSettingsError::Unencrypted(_))));
        let bare = UploadSettings { listen: vec!["tls/0.0.0.0:7447".into()], ..Default::default() };
        assert!(matches!(bare.validate(), Err(UploadSettingsError::NoCertificates(_))));
        assert_eq!(UploadSettings { tls: Some(tls), ..bare }.validate(), Ok(()));
    }

    #[test]
    fn defaults_are_valid_and_unknown_keys_are_not() {
        assert_eq!(UploadSettings::default().validate(), Ok(()));
        assert_eq!(toml::from_str::<UploadSettings>("").ok(), Some(UploadSettings::default()));
        assert!(toml::from_str::<UploadSettings>("conect = []").is_err());
        assert!(toml::from_str::<UploadSettings>("retry_min_s = 99.0").is_ok_and(|s| s.validate().is_err()));
    }
}
