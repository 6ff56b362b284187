//! The signing key from its file, and the time stamp kept in the state folder: signing time stamps must never go back, also over a
//! restart on a computer without a battery-backed clock.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use config::link::{LinkSettings, Signing};
use disk::{Disk, told};

use super::signing::{Signer, SigningMode, timestamp_of_unix_us};
use crate::error::HalError;

/// The stored time stamp is this far ahead of the one in use, so that it is written once a minute and still never
/// reused after a crash. 10 µs ticks.
const RESERVE: u64 = 60 * 100_000;

/// 64 hexadecimal digits with blanks around them.
const MOST_BYTES: u64 = 256;

/// Keeps the time stamp.
pub struct SigningStore {
    path: PathBuf,
    stored: u64,
}

/// The signer that the settings ask for, and the keeper of its time stamp.
///
/// # Errors
/// [`HalError::Signing`] when signing is asked for and the key is missing or not a key.
pub fn open(settings: &LinkSettings) -> Result<(Signer, Option<SigningStore>), HalError> {
    let mode = match settings.signing {
        Signing::Off => return Ok((Signer::off(), None)),
        Signing::Accept => SigningMode::Accept,
        Signing::Require => SigningMode::Require,
    };
    let Some(path) = &settings.signing_key else {
        let why = "link.signing is on but link.signing_key names no key file".into();
        return Err(HalError::Signing { path: "link.signing_key".into(), why });
    };
    let key = read_key(path)?;
    let beside = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut store = SigningStore::of(path, &config::state::folder(beside))?;
    let now_us = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64);
    let start = store.stored.max(timestamp_of_unix_us(now_us));
    let mut signer = Signer::new(mode, key, settings.own_component, start);
    store.keep(&mut signer)?;
    Ok((signer, Some(store)))
}

/// As much of a file as a key or a time stamp can have, and one byte more.
fn read(path: &Path) -> std::io::Result<Vec<u8>> {
    bounded(disk::regular::open(path)?)
}

fn bounded(file: File) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    file.take(MOST_BYTES + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Zeros are what a disk gives that lost the key, and anybody's first guess.
fn usable(key: [u8; 32]) -> Result<[u8; 32], String> {
    if key == [0; 32] { Err("is all zeros; make a new key".into()) } else { Ok(key) }
}

fn read_key(path: &Path) -> Result<[u8; 32], HalError> {
    let wrong = |why: String| HalError::Signing { path: path.into(), why };
    let file = disk::regular::open_secret(path).map_err(|e| wrong(told(&e).to_string()))?;
    let bytes = bounded(file).map_err(|e| wrong(told(&e).to_string()))?;
    if let Ok(key) = <[u8; 32]>::try_from(bytes.as_slice()) {
        return usable(key).map_err(wrong);
    }
    let digits: Vec<u32> = bytes.trim_ascii().iter().map_while(|b| char::from(*b).to_digit(16)).collect();
    let pairs: Vec<u8> = digits.chunks_exact(2).map(|d| (d[0] * 16 + d[1]) as u8).collect();
    match <[u8; 32]>::try_from(pairs) {
        Ok(key) if bytes.trim_ascii().len() == 64 => usable(key).map_err(wrong),
        _ => Err(wrong(format!("{} bytes; a key is 32 bytes or 64 hexadecimal digits", bytes.len()))),
    }
}

impl SigningStore {
    /// The keeper of the time stamp of `key` in the folder `state`. One that was kept beside the key counts, too.
    fn of(key: &Path, state: &Path) -> Result<Self, HalError> {
        let mut name = key.file_name().unwrap_or_default().to_owned();
        name.push(".timestamp");
        let mut store = Self { path: state.join(&name), stored: 0 };
        store.stored = store.read()?;
        let beside = key.with_file_name(name);
        if beside != store.path
            && let Ok(Ok(text)) = read(&beside).map(String::from_utf8)
        {
            let stamp = text.trim().parse().ok().filter(|stamp: &u64| stamp >> 48 == 0);
            store.stored = store.stored.max(stamp.unwrap_or(0).saturating_add(RESERVE));
        }
        Ok(store)
    }

    /// The newest time stamp that can be read. Damage never keeps an aircraft on the ground: with what is lost the reserve of
    /// two writes is skipped, so that no time stamp is used again.
    fn read(&self) -> Result<u64, HalError> {
        let stamp = |path: &Path| {
            let bytes = read(path).map_err(|e| e.to_string())?;
            let text = std::str::from_utf8(&bytes).unwrap_or_default();
            // 48 bits on the wire.
            let stamp = text.trim().parse().ok().filter(|stamp: &u64| stamp >> 48 == 0);
            stamp.ok_or_else(|| format!("{}: not a time stamp", path.display()))
        };
        let wrong = |e: std::io::Error| HalError::Signing { path: self.path.clone(), why: told(&e).to_string() };
        let newest = Disk::default().newest(&self.path, stamp).map_err(wrong)?;
        newest.damaged.iter().for_each(|d| tracing::warn!("{d}"));
        let skipped = if newest.damaged.is_empty() { 0 } else { 2 * RESERVE };
        Ok(newest.found.unwrap_or(0).saturating_add(skipped))
    }

    /// Writes the time stamp when the reserve is used up.
    ///
    /// # Errors
    /// [`HalError::Signing`] when it cannot be written.
    pub fn keep(&mut self, signer: &mut Signer) -> Result<(), HalError> {
        if signer.timestamp() < self.stored {
            return Ok(());
        }
        let stamp = signer.timestamp() + RESERVE;
        let written = Disk::default().replace_keeping(&self.path, |out| writeln!(out, "{stamp}"));
        written.map_err(|e| HalError::Signing { path: self.path.clone(), why: told(&e.source).to_string() })?;
        self.stored = stamp;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn write_key(path: &Path, key: impl AsRef<[u8]>) {
        std::fs::write(path, key).expect("written");
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600)).expect("its own");
    }

    fn settings(key: &Path) -> LinkSettings {
        LinkSettings { signing: Signing::Require, signing_key: Some(key.into()), ..LinkSettings::default() }
    }

    #[test]
    fn the_time_stamp_never_goes_back_over_a_restart() {
        let folder = tempfile::tempdir().expect("a folder");
        let key = folder.path().join("key");
        write_key(&key, [7; 32]);
        let (first, _) = open(&settings(&key)).expect("opens");
        let (second, _) = open(&settings(&key)).expect("opens");
        assert!(second.timestamp() >= first.timestamp() + RESERVE);
    }

    #[test]
    fn a_key_where_nothing_may_be_written_is_flown_with_its_time_stamp_in_the_state_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let (key, state) = (folder.path().join("etc/key"), folder.path().join("state"));
        std::fs::create_dir(folder.path().join("etc")).expect("made");
        write_key(&key, [7; 32]);
        // As an earlier release left it.
        std::fs::write(folder.path().join("etc/key.timestamp"), "700000000000").expect("written");
        let mut store = SigningStore::of(&key, &state).expect("opens");
        assert_eq!(store.stored, 700_000_000_000 + RESERVE);
        let mut signer = Signer::new(SigningMode::Require, [7; 32], 1, store.stored);
        store.keep(&mut signer).expect("written");
        assert!(state.join("key.timestamp").is_file());
        assert_eq!(std::fs::read(folder.path().join("etc/key.timestamp")).expect("read"), b"700000000000");
        assert!(SigningStore::of(&key, &state).expect("opens").stored >= store.stored);
    }

    #[test]
    fn a_damaged_time_stamp_is_set_aside_and_none_is_used_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let key = folder.path().join("key");
        write_key(&key, [7; 32]);
        open(&settings(&key)).expect("opens");
        let (last, _) = open(&settings(&key)).expect("opens");
        let stamp = folder.path().join("key.timestamp");
        std::fs::write(&stamp, b"\xff\xfe").expect("damaged");
        let (again, _) = open(&settings(&key)).expect("a damaged file does not keep it from opening");
        assert!(again.timestamp() > last.timestamp());
        assert_eq!(std::fs::read(folder.path().join("key.damaged-1.timestamp")).expect("set aside"), b"\xff\xfe");
    }

    #[test]
    fn keys_of_zeros_and_keys_that_others_may_read_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let key = folder.path().join("key");
        for zeros in [vec![0; 32], b"00".repeat(32)] {
            write_key(&key, zeros);
            let error = open(&settings(&key)).err().expect("refused").to_string();
            assert!(error.contains("all zeros"), "{error}");
        }
        write_key(&key, [7; 32]);
        std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o644)).expect("its own");
        let error = open(&settings(&key)).err().expect("refused").to_string();
        assert!(error.contains("mode 644") && error.contains("chmod 600"), "{error}");
    }

    #[test]
    fn keys_are_read_raw_or_in_hexadecimal_and_nothing_else() {
        let folder = tempfile::tempdir().expect("a folder");
        let key = folder.path().join("key");
        write_key(&key, "0a".repeat(32) + "\n");
        assert_eq!(read_key(&key).expect("a key"), [10; 32]);
        write_key(&key, "secret");
        let error = open(&settings(&key)).err().expect("refused").to_string();
        assert!(error.contains("64 hexadecimal digits"), "{error}");
        let error = open(&settings(&folder.path().join("none"))).err().expect("refused").to_string();
        assert!(error.contains("none"), "{error}");
    }
}
