//! Which flight of its aircraft this is: a number that grows with every start of the job and is kept in a file.

use std::path::{Path, PathBuf};

use disk::Disk;

use super::folder::{read_not_linked, write_whole};

/// The number of the present flight.
#[derive(Debug)]
pub struct FlightNumber {
    path: Option<PathBuf>,
    number: u64,
}

impl FlightNumber {
    /// The number after the one in the file, which it replaces. A missing or unreadable file counts as 0: the ground's next
    /// receipt says where to go on.
    pub fn begin(path: Option<&Path>) -> Self {
        let text = path.and_then(|p| read_not_linked(p, 64).ok()).and_then(|bytes| String::from_utf8(bytes).ok());
        if let Some(folder) = path.and_then(Path::parent) {
            // Aircraft of one machine share the folder of the keys.
            Disk::default().sweep_abandoned(folder);
        }
        let last = text.and_then(|t| t.trim().parse().ok()).unwrap_or(0);
        let mut this = Self { path: path.map(Path::to_path_buf), number: last };
        this.advance_beyond(last);
        this
    }

    /// The number.
    pub fn get(&self) -> u64 {
        self.number
    }

    /// Goes on beyond `other`.
    pub fn advance_beyond(&mut self, other: u64) {
        self.number = self.number.max(other).saturating_add(1);
        if let Some(path) = &self.path
            && let Err(e) = write_whole(path, format!("{}\n", self.number).as_bytes())
        {
            tracing::warn!(
                "upload: {}: the number of this flight will be used again: {}",
                path.display(),
                disk::told(&e)
            );
        }
    }
}

/// Takes over the number that an earlier release kept in `before`.
pub(crate) fn take_over(before: &Path, now: &Path) {
    if let Ok(number) = read_not_linked(before, 64)
        && let Err(e) = write_whole(now, &number)
    {
        tracing::warn!("upload: {}: {}", now.display(), disk::told(&e));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flights_are_numbered_over_restarts_and_a_damaged_file_starts_anew() {
        let dir = tempfile::tempdir().expect("temp dir");
        let path = dir.path().join("a1.flight");
        assert_eq!((FlightNumber::begin(Some(&path)).get(), FlightNumber::begin(Some(&path)).get()), (1, 2));
        let mut third = FlightNumber::begin(Some(&path));
        third.advance_beyond(40);
        assert_eq!((third.get(), FlightNumber::begin(Some(&path)).get()), (41, 42));
        std::fs::write(&path, b"\xff4").expect("write");
        assert_eq!(FlightNumber::begin(Some(&path)).get(), 1);
        // Not even a folder to write to keeps an aircraft on the ground.
        assert_eq!(FlightNumber::begin(Some(&dir.path().join("none/a1.flight"))).get(), 1);
    }
}
