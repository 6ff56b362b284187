//! Which mission an output folder belongs to, and which process writes to it: one at a time, one mission at a time.
//!
//! A job that finds another mission's files (or a ground station that finds a session it has finished) puts them aside under
//! `earlier-N/` instead of continuing, replacing or reporting them as its own.

use std::io;
use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use disk::{Disk, DiskError, FolderLock};
use models::formats::{FormatError, read_bounded};
use serde::{Deserialize, Serialize};

use crate::run_json::RunReport;

/// Says whose folder it is.
const FILE: &str = "session.json";
/// Bound on it; it has a few hundred bytes.
const LIMIT: u64 = 1 << 16;
/// Earlier sessions in one folder that are kept apart.
const MAX_EARLIER: u32 = 9999;

/// Why a job may not write to a folder.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// Another process does.
    #[error("{}: another dgtr is writing there; wait for it or give another --out", .0.display())]
    Busy(PathBuf),
    /// The system says no.
    #[error("{}: {} failed: {}", path.display(), source.action, disk::told(&source.source))]
    Disk {
        /// The folder or file.
        path: PathBuf,
        /// What failed.
        source: DiskError,
    },
    /// More sessions than are kept apart.
    #[error("{}: holds {MAX_EARLIER} earlier sessions; give another --out", .0.display())]
    Crowded(PathBuf),
}

impl Error for SessionError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Busy(_) | Self::Crowded(_) => ErrorKind::Input,
            Self::Disk { source, .. } => Error::kind(&source.source),
        }
    }
}

/// What a folder is for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Owner {
    /// `fly`, `serve`.
    pub command: String,
    /// Name of the mission.
    pub mission: String,
    /// Id of the aircraft; empty for the ground.
    pub aircraft: String,
    /// Latitude and longitude in degrees and altitude in metres of the mission's origin.
    pub origin: [f64; 3],
    /// Width and height of the pictures that are kept, pixels; zeros where none are.
    pub picture: [u32; 2],
}

/// The right to write to a folder; ends with the process at the latest.
#[derive(Debug)]
pub struct Session {
    _lock: FolderLock,
    /// Where the files of an earlier session were put.
    pub put_aside: Option<PathBuf>,
}

impl Session {
    /// Makes `out` this process's own: locks it, sweeps what a kill left half written, and puts another mission's files aside.
    /// A ground session that has ended well is over: the next one begins with nothing.
    ///
    /// # Errors
    /// [`SessionError`].
    pub fn begin(disk: &Disk, out: &Path, owner: &Owner) -> Result<Self, SessionError> {
        let failed = |action| {
            move |source: io::Error| SessionError::Disk { path: out.into(), source: DiskError { action, source } }
        };
        disk.make_folders(out).map_err(failed("making the folder"))?;
        let lock = FolderLock::take(out).map_err(failed("opening the folder"))?;
        let lock = lock.ok_or_else(|| SessionError::Busy(out.into()))?;
        if !lock.held() {
            tracing::warn!("{}: cannot be locked; nothing keeps a second dgtr out", out.display());
        }
        disk.sweep(out);
        disk.sweep(&out.join("map"));
        let path = out.join(FILE);
        let newest = disk.newest(&path, read_owner).map_err(failed("setting session.json aside"))?;
        newest.damaged.iter().for_each(|d| tracing::warn!("{d}; what is here is taken for this session's"));
        let before = newest.found;
        let over = owner.command == "serve" && RunReport::read(out).is_ok_and(|r| r.outcome == "done");
        let mut put_aside = None;
        if before.as_ref().is_some_and(|before| before != owner || over) {
            let aside = put_aside_in(disk, out)?;
            let mission = before.as_ref().map_or("", |b| b.mission.as_str());
            tracing::warn!("{}: holds the files of mission {mission:?}, moved to {}", out.display(), aside.display());
            put_aside = Some(aside);
        }
        if put_aside.is_some() || before.is_none() {
            let json = serde_json::to_vec(owner).map_err(|e| failed("encoding")(e.into()))?;
            let written = disk.replace(&path, |file| file.write_all(&json));
            written.map_err(|source| SessionError::Disk { path, source })?;
        }
        Ok(Self { _lock: lock, put_aside })
    }
}

/// Where the files of the newest session before this one in `out` lie.
pub fn newest_earlier(out: &Path) -> Option<PathBuf> {
    (1..=MAX_EARLIER).map(|n| out.join(format!("earlier-{n}"))).take_while(|p| p.join(FILE).exists()).last()
}

/// Whose `out` was, as far as it says.
pub fn owner(out: &Path) -> Option<Owner> {
    read_owner(&out.join(FILE)).ok()
}

fn read_owner(path: &Path) -> Result<Owner, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    serde_json::from_slice(&bytes)
        .map_err(|e| FormatError::Invalid { path: path.into(), what: format!("does not say whose folder it is: {e}") })
}

/// Moves everything in `out` into a folder below it, what says whose it is last: a move that was cut short goes on into the
/// same folder.
fn put_aside_in(disk: &Disk, out: &Path) -> Result<PathBuf, SessionError> {
    let failed = |path: &Path, source| SessionError::Disk {
        path: path.into(),
        source: DiskError { action: "putting the earlier session aside", source },
    };
    let earlier = (1..=MAX_EARLIER).map(|n| out.join(format!("earlier-{n}"))).find(|p| !p.join(FILE).exists());
    let earlier = earlier.ok_or_else(|| SessionError::Crowded(out.into()))?;
    disk.make_folders(&earlier).map_err(|e| failed(&earlier, e))?;
    let entries = std::fs::read_dir(out).map_err(|e| failed(out, e))?;
    let is_earlier = |name: &str| name.strip_prefix("earlier-").is_some_and(|n| n.parse::<u32>().is_ok());
    let names = entries.flatten().map(|e| e.file_name()).filter(|n| !n.to_str().is_some_and(is_earlier));
    let mut names: Vec<_> = names.collect();
    names.sort_by_key(|n| n == FILE);
    for name in names {
        let (from, to) = (out.join(&name), earlier.join(&name));
        match disk.rename(&from, &to) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(failed(&from, e)),
            _ => {}
        }
    }
    Ok(earlier)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn owner(command: &str, mission: &str) -> Owner {
        let (command, mission) = (command.to_owned(), mission.to_owned());
        Owner { command, mission, aircraft: "one".into(), origin: [46.0, 7.0, 500.0], picture: [640, 480] }
    }

    #[test]
    fn a_second_process_is_refused_in_one_line_until_the_first_has_ended() {
        let dir = tempfile::tempdir().expect("folder");
        let (disk, out) = (Disk::default(), dir.path().join("out"));
        let first = Session::begin(&disk, &out, &owner("fly", "park")).expect("free");
        let e = Session::begin(&disk, &out, &owner("fly", "park")).expect_err("taken").to_string();
        assert!(e.contains("another dgtr is writing there") && e.lines().count() == 1, "{e}");
        drop(first);
        assert!(Session::begin(&disk, &out, &owner("fly", "park")).expect("free again").put_aside.is_none());
    }

    #[test]
    fn another_mission_begins_with_nothing_and_the_earlier_one_is_kept_by_name() {
        let dir = tempfile::tempdir().expect("folder");
        let (disk, out) = (Disk::default(), dir.path());
        for (mission, aside) in [("monday", None), ("monday", None), ("tuesday", Some(1)), ("monday", Some(2))] {
            let session = Session::begin(&disk, out, &owner("fly", mission)).expect("begins");
            assert_eq!(session.put_aside, aside.map(|n| out.join(format!("earlier-{n}"))));
            assert!(aside.is_none() || !out.join("x").exists() && !out.join("keyframes").exists());
            std::fs::create_dir_all(out.join("keyframes/images")).expect("made");
            std::fs::write(out.join("x"), mission).expect("written");
        }
        assert_eq!(std::fs::read_to_string(out.join("earlier-1/x")).expect("kept"), "monday");
        assert_eq!(std::fs::read_to_string(out.join("earlier-2/x")).expect("kept"), "tuesday");
        assert!(out.join("earlier-2/keyframes/images").is_dir());
    }

    #[test]
    fn a_ground_session_that_is_over_is_put_aside_and_one_that_is_not_goes_on() {
        let dir = tempfile::tempdir().expect("folder");
        let (disk, out) = (Disk::default(), dir.path());
        let begin = || Session::begin(&disk, out, &owner("serve", "park")).expect("begins").put_aside.is_some();
        assert!(!begin());
        for (outcome, over) in [("interrupted", false), ("done", true)] {
            let mut report = RunReport::new("serve");
            report.outcome = outcome.into();
            report.write(out).expect("written");
            assert_eq!(begin(), over);
        }
        assert!(!begin() && out.join("earlier-1/run.json").is_file());
        assert_eq!(newest_earlier(out), Some(out.join("earlier-1")));
        assert_eq!(newest_earlier(&out.join("earlier-1")), None);
    }

    #[test]
    fn a_damaged_session_file_is_set_aside_by_name_and_the_job_goes_on() {
        let dir = tempfile::tempdir().expect("folder");
        let (disk, out) = (Disk::default(), dir.path());
        drop(Session::begin(&disk, out, &owner("fly", "park")).expect("begins"));
        std::fs::write(out.join("model.dgtr"), "a day's work").expect("written");
        std::fs::write(out.join(FILE), "{\"command\":").expect("cut");
        let session = Session::begin(&disk, out, &owner("fly", "park")).expect("begins");
        assert!(session.put_aside.is_none() && out.join("model.dgtr").is_file());
        assert_eq!(std::fs::read_to_string(out.join("session.damaged-1.json")).expect("kept"), "{\"command\":");
        assert_eq!(read_owner(&out.join(FILE)).expect("written anew"), owner("fly", "park"));
    }

    #[test]
    fn what_a_kill_left_half_written_is_gone_after_the_next_start() {
        let dir = tempfile::tempdir().expect("folder");
        std::fs::write(dir.path().join(".dgtr-12-0"), [0; 4096]).expect("written");
        let _session = Session::begin(&Disk::default(), dir.path(), &owner("fly", "park")).expect("begins");
        let names: Vec<_> = std::fs::read_dir(dir.path()).expect("folder").flatten().map(|e| e.file_name()).collect();
        assert_eq!(names, [FILE]);
    }
}
