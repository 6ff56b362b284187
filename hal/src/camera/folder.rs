//! A folder that another program writes pictures into. Files appear slowly, half written, out of order, under temporary
//! names; a picture is handed out once it is whole.

use std::collections::HashMap;
use std::fs::Metadata;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::exif::camera_clock;
use super::jpeg::is_complete;
use super::picture::Picture;
use crate::error::HalError;
use crate::traits::{Camera, PictureClues};

/// How often the folder is listed. A listing of some thousand files takes milliseconds; notification services are
/// missing on network and FUSE mounts, where cameras' cards often live.
const SCAN_EVERY_NS: u64 = 100_000_000;
/// A file that is not whole and has not grown for this long is broken.
const STALLED_NS: u64 = 10_000_000_000;
/// Most files of one mission; beyond it the folder is certainly the wrong one.
const MAX_FILES: usize = 1 << 17;
/// Most files that grow at the same time.
const MAX_GROWING: usize = 64;
/// Every so many listings, what was handed out is looked at again: a camera program that was restarted numbers anew and writes
/// over its old files.
const RECHECK: u64 = 10;

struct Growing {
    path: PathBuf,
    size: u64,
    since_ns: u64,
}

/// Which file system a folder is on, and which folder it is there: another one after its medium was unmounted.
type Place = (u64, u64);

/// A watched folder.
pub struct FolderCamera {
    folder: PathBuf,
    /// `None` while it is not there.
    place: Option<Place>,
    /// What was written before is of an earlier flight.
    since: SystemTime,
    /// Hashes of the names that were handed out or given up, and of size and time of what was.
    done: HashMap<u64, u64>,
    growing: Vec<Growing>,
    /// Whole pictures waiting, the next one last.
    ready: Vec<(PictureClues, PathBuf)>,
    next_scan_ns: u64,
    scans: u64,
    /// Files arrive when they are seen, not when they were written.
    simulated_clock: bool,
}

fn hash(of: impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    of.hash(&mut hasher);
    hasher.finish()
}

fn key(path: &Path) -> u64 {
    hash(path.file_name())
}

/// Changes when a file is written anew under its old name.
fn version(meta: &Metadata) -> u64 {
    hash((meta.len(), meta.modified().ok()))
}

fn place(folder: &Path) -> std::io::Result<Place> {
    folder.metadata().map(|m| (m.dev(), m.ino()))
}

/// The last run of digits in a file's name: `DJI_0054.jpg` is 54.
fn number_of(path: &Path) -> Option<u64> {
    let stem = path.file_stem()?.to_str()?;
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end]
        .rfind(|c: char| !c.is_ascii_digit())
        .map_or(0, |i| i + stem[i..].chars().next().map_or(1, char::len_utf8));
    stem[start..end].parse().ok()
}

fn is_picture(path: &Path) -> bool {
    let hidden = path.file_name().and_then(|n| n.to_str()).is_none_or(|n| n.starts_with('.'));
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    !hidden && matches!(extension.as_deref(), Some("jpg" | "jpeg" | "png"))
}

impl FolderCamera {
    /// Watches `folder`. Files that are already there belong to an earlier flight and are passed over.
    ///
    /// # Errors
    /// [`HalError::Camera`] when it is not a readable folder.
    pub fn open(folder: &Path) -> Result<Self, HalError> {
        Self::open_since(folder, None)
    }

    /// As [`FolderCamera::open`], but files written after `since` belong to this flight: it was interrupted then.
    ///
    /// # Errors
    /// Errors of [`FolderCamera::open`].
    pub fn open_since(folder: &Path, since: Option<SystemTime>) -> Result<Self, HalError> {
        let mut camera = Self {
            folder: folder.into(),
            place: None,
            since: since.unwrap_or_else(SystemTime::now),
            done: HashMap::new(),
            growing: Vec::with_capacity(MAX_GROWING),
            ready: Vec::new(),
            next_scan_ns: 0,
            scans: 0,
            simulated_clock: false,
        };
        camera.place = match place(folder) {
            Ok(at) => Some(at),
            // A medium that is mounted later.
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => None,
            Err(e) => return Err(camera.wrong(format!("{e}; create it or correct the mission's camera"))),
        };
        if camera.place.is_some() {
            camera.pass_over(since)?;
        }
        Ok(camera)
    }

    /// What lies there already is of earlier flights, unless it was written after `since`.
    fn pass_over(&mut self, since: Option<SystemTime>) -> Result<(), HalError> {
        let earlier = |meta: &Metadata| since.is_none_or(|since| meta.modified().is_ok_and(|at| at <= since));
        for path in self.list()? {
            let Ok(meta) = path.metadata() else { continue };
            if earlier(&meta) && is_complete(&path).unwrap_or(false) {
                self.done.insert(key(&path), version(&meta));
            }
        }
        Ok(())
    }

    /// For a clock that is not the wall's: the age of a file says nothing then.
    pub fn on_simulated_clock(self) -> Self {
        Self { simulated_clock: true, ..self }
    }

    fn wrong(&self, why: String) -> HalError {
        HalError::Camera { what: format!("folder {}", self.folder.display()), why }
    }

    /// Names that may be pictures. Entries that cannot be read are passed over: the others can.
    fn list(&self) -> Result<Vec<PathBuf>, HalError> {
        let entries = std::fs::read_dir(&self.folder)
            .map_err(|e| self.wrong(format!("{e}; is its medium mounted? It is looked at again")))?;
        let names = entries.flatten().map(|entry| entry.path()).filter(|path| is_picture(path));
        Ok(names.take(MAX_FILES).collect())
    }

    fn scan(&mut self, now_ns: u64) -> Result<(), HalError> {
        self.scans += 1;
        let recheck = self.scans.is_multiple_of(RECHECK);
        let now_at = place(&self.folder).ok().or(self.place);
        match (std::mem::replace(&mut self.place, now_at), now_at) {
            (None, None) => return Ok(()),
            (None, Some(_)) => {
                self.pass_over(Some(self.since))?;
                let (folder, earlier) = (self.folder.display(), self.done.len());
                tracing::info!(
                    "folder {folder} is there; {earlier} pictures in it are older than the start and left out"
                );
            }
            (before, now) if before != now => {
                return Err(self.wrong("another file system is there now; was its medium unmounted?".into()));
            }
            _ => {}
        }
        let mut broken = None;
        for path in self.list()? {
            let done = self.done.get(&key(&path)).copied();
            if done.is_some() && !recheck {
                continue;
            }
            // Gone again between listing and looking: renamed or deleted, the next scan knows.
            let Ok(meta) = path.metadata().map_err(drop).and_then(|m| if m.is_file() { Ok(m) } else { Err(()) }) else {
                continue;
            };
            if done == Some(version(&meta)) {
                continue;
            }
            let complete = is_complete(&path);
            if complete.as_ref().is_ok_and(|complete| *complete) {
                self.growing.retain(|g| g.path != path);
                self.take(path, &meta, now_ns, done.is_some());
            } else if let Some(g) = self.growing.iter_mut().find(|g| g.path == path) {
                if g.size != meta.len() {
                    (g.size, g.since_ns) = (meta.len(), now_ns);
                } else if now_ns.saturating_sub(g.since_ns) > STALLED_NS {
                    self.done.insert(key(&path), version(&meta));
                    let why = complete
                        .err()
                        .map_or("half written and no longer growing".into(), |e| disk::told(&e).to_string());
                    broken = Some((path, why));
                }
            } else if self.growing.len() < MAX_GROWING {
                self.growing.push(Growing { path, size: meta.len(), since_ns: now_ns });
            }
        }
        // By number, so that files that came within one scan are handed out in the camera's order.
        self.ready.sort_by(|(a, p), (b, q)| (b.number, q).cmp(&(a.number, p)));
        match broken {
            Some((path, why)) => {
                self.growing.retain(|g| g.path != path);
                Err(HalError::Picture { path, why: format!("{why}; left out") })
            }
            None => Ok(()),
        }
    }

    /// A whole picture; `anew` under the name of an earlier one, so that its number says nothing.
    fn take(&mut self, path: PathBuf, meta: &Metadata, now_ns: u64, anew: bool) {
        if self.done.len() >= MAX_FILES {
            return;
        }
        self.done.insert(key(&path), version(meta));
        // When its last byte was written, on our clock; a clock that was set meanwhile counts for a scan at most.
        let age = meta.modified().ok().and_then(|m| SystemTime::now().duration_since(m).ok());
        let longest_ns = if self.simulated_clock { 0 } else { 2 * SCAN_EVERY_NS };
        let age_ns = age.map_or(0, |a| a.as_nanos() as u64).min(longest_ns);
        let (camera_ns, camera_resolution_ns) = camera_clock(&path).unzip();
        let written = meta.modified().ok().filter(|_| !self.simulated_clock);
        let written = written.and_then(|at| at.duration_since(SystemTime::UNIX_EPOCH).ok());
        let clues = PictureClues {
            arrived_ns: now_ns.saturating_sub(age_ns),
            number: if anew { None } else { number_of(&path) },
            camera_ns,
            camera_resolution_ns: camera_resolution_ns.unwrap_or(0),
            written_ns: written.and_then(|at| u64::try_from(at.as_nanos()).ok()),
            ..PictureClues::default()
        };
        self.ready.push((clues, path));
    }
}

impl Camera for FolderCamera {
    type Picture = Picture;
    type Error = HalError;

    fn next_picture(&mut self, now_ns: u64) -> Result<Option<(PictureClues, Picture)>, HalError> {
        if self.ready.is_empty() && now_ns >= self.next_scan_ns {
            self.next_scan_ns = now_ns + SCAN_EVERY_NS;
            self.scan(now_ns)?;
        }
        Ok(self.ready.pop().map(|(clues, path)| (clues, Picture::Path(path))))
    }

    /// Pictures in it when it comes are of this flight if they were written since the start.
    fn is_missing(&self) -> bool {
        self.place.is_none()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jpeg() -> Vec<u8> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        image::RgbImage::new(8, 8).write_to(&mut bytes, image::ImageFormat::Jpeg).expect("encodes");
        bytes.into_inner()
    }

    fn names(camera: &mut FolderCamera, now_ns: u64) -> Vec<String> {
        let mut names = Vec::new();
        while let Ok(Some((_, picture))) = camera.next_picture(now_ns) {
            names.push(picture.name().file_name().expect("a name").to_string_lossy().into_owned());
        }
        names
    }

    #[test]
    fn pictures_are_handed_out_once_whole_and_in_the_cameras_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let put = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).expect("written");
        let whole = jpeg();
        put("old_1.jpg", &whole);
        let mut camera = FolderCamera::open(folder.path()).expect("opens");
        put("dji_10.jpg", &whole);
        put("DJI_0009.JPG", &whole);
        put("dji_11.jpg", &whole[..whole.len() - 3]);
        put(".dji_12.jpg", &whole);
        put("dji_13.jpg.part", &whole);
        assert_eq!(names(&mut camera, 1), ["DJI_0009.JPG", "dji_10.jpg"]);
        put("dji_11.jpg", &whole);
        assert_eq!(names(&mut camera, 1 + SCAN_EVERY_NS), ["dji_11.jpg"]);
        assert!(names(&mut camera, 9 * SCAN_EVERY_NS).is_empty());
    }

    #[test]
    fn pictures_that_came_while_nobody_watched_are_taken_when_a_flight_is_continued() {
        let folder = tempfile::tempdir().expect("a folder");
        let stopped = SystemTime::now() - std::time::Duration::from_secs(600);
        for (name, age_s) in [("a_1.jpg", 900), ("a_2.jpg", 300), ("a_3.jpg", 200)] {
            let path = folder.path().join(name);
            std::fs::write(&path, jpeg()).expect("written");
            let file = std::fs::File::options().write(true).open(&path).expect("opens");
            file.set_modified(SystemTime::now() - std::time::Duration::from_secs(age_s)).expect("set");
        }
        let mut camera = FolderCamera::open_since(folder.path(), Some(stopped)).expect("opens");
        assert_eq!(names(&mut camera, 1), ["a_2.jpg", "a_3.jpg"]);
        assert!(names(&mut FolderCamera::open(folder.path()).expect("opens"), 1).is_empty());
    }

    #[test]
    fn a_file_that_stays_half_written_is_reported_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut camera = FolderCamera::open(folder.path()).expect("opens");
        std::fs::write(folder.path().join("a_1.jpg"), &jpeg()[..100]).expect("written");
        assert_eq!(camera.next_picture(0).expect("waits"), None);
        let error = camera.next_picture(2 * STALLED_NS).expect_err("reported").to_string();
        assert!(error.contains("a_1.jpg") && error.contains("half written"), "{error}");
        assert_eq!(camera.next_picture(4 * STALLED_NS).expect("once"), None);
    }

    #[test]
    fn numbers_are_read_from_names() {
        for (name, number) in [("DJI_0054.jpg", Some(54)), ("7.png", Some(7)), ("x.jpg", None), ("é12é.jpg", Some(12))]
        {
            assert_eq!(number_of(Path::new(name)), number, "{name}");
        }
        assert_eq!(number_of(Path::new("99999999999999999999999.jpg")), None);
    }

    #[test]
    fn a_missing_folder_is_waited_for_and_only_what_was_written_since_counts() {
        let above = tempfile::tempdir().expect("a folder");
        let folder = above.path().join("camera");
        let mut camera = FolderCamera::open(&folder).expect("it may be mounted later");
        assert!(camera.is_missing() && camera.next_picture(0).expect("nothing is wrong").is_none());
        std::fs::create_dir(&folder).expect("a folder");
        for (name, age_s) in [("a_1.jpg", 3600), ("a_2.jpg", 0)] {
            let file = std::fs::File::create(folder.join(name)).expect("a file");
            std::io::Write::write_all(&mut &file, &jpeg()).expect("written");
            let at = SystemTime::now() + std::time::Duration::from_secs(1) - std::time::Duration::from_secs(age_s);
            file.set_modified(at).expect("a time");
        }
        let (clues, _) = camera.next_picture(SCAN_EVERY_NS).expect("it reads").expect("the new one");
        assert_eq!((clues.number, camera.is_missing()), (Some(2), false));
        assert!(
            camera.next_picture(2 * SCAN_EVERY_NS).expect("it reads").is_none(),
            "the old one is of an earlier flight"
        );
        let file = above.path().join("file");
        std::fs::write(&file, "").expect("written");
        let error = FolderCamera::open(&file.join("below")).err().expect("no folder can come there");
        assert!(error.to_string().contains("below"), "{error}");
    }

    #[test]
    fn what_cannot_be_read_costs_no_picture_and_nobody_waits_for_a_fifo() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        rustix::fs::mknodat(rustix::fs::CWD, at("a_1.jpg"), rustix::fs::FileType::Fifo, 0o600.into(), 0)
            .expect("a FIFO");
        std::fs::create_dir(at("a_2.jpg")).expect("a folder");
        symlink("/nonexistent", at("a_3.jpg")).expect("a link");
        symlink(at("a_1.jpg"), at("a_4.jpg")).expect("a link");
        let mut camera = FolderCamera::open(folder.path()).expect("opens");
        std::fs::write(at("a_5.jpg"), jpeg()).expect("written");
        // Another user's file, unless this user may read everything.
        std::fs::write(at("a_6.jpg"), jpeg()).expect("written");
        std::fs::set_permissions(at("a_6.jpg"), std::fs::Permissions::from_mode(0o000)).expect("set");
        let everything = std::fs::File::open(at("a_6.jpg")).is_ok();
        let expected = if everything { vec!["a_5.jpg", "a_6.jpg"] } else { vec!["a_5.jpg"] };
        assert_eq!(names(&mut camera, 1), expected);
        assert!(disk::regular::open(&at("a_1.jpg")).is_err(), "refused, not waited for");
        if !everything {
            let error = camera.next_picture(2 * STALLED_NS).expect_err("named once").to_string();
            assert!(error.contains("a_6.jpg") && error.contains("ermission"), "{error}");
        }
    }

    #[test]
    fn a_folder_that_is_unmounted_or_replaced_is_noticed_once_and_watched_on() {
        let parent = tempfile::tempdir().expect("a folder");
        let folder = parent.path().join("card");
        std::fs::create_dir(&folder).expect("a folder");
        let mut camera = FolderCamera::open(&folder).expect("opens");
        std::fs::rename(&folder, parent.path().join("away")).expect("renamed");
        let error = camera.next_picture(1).expect_err("gone").to_string();
        assert!(error.contains("mounted"), "{error}");
        std::fs::create_dir(&folder).expect("a folder");
        let error = camera.next_picture(1 + SCAN_EVERY_NS).expect_err("another one").to_string();
        assert!(error.contains("unmounted"), "{error}");
        std::fs::write(folder.join("a_1.jpg"), jpeg()).expect("written");
        assert_eq!(names(&mut camera, 1 + 2 * SCAN_EVERY_NS), ["a_1.jpg"]);
    }

    #[test]
    fn a_restarted_camera_that_writes_over_its_files_takes_new_pictures() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut camera = FolderCamera::open(folder.path()).expect("opens");
        let path = folder.path().join("frame_000001.jpg");
        std::fs::write(&path, jpeg()).expect("written");
        assert_eq!(names(&mut camera, 1), ["frame_000001.jpg"]);
        std::fs::write(&path, [jpeg(), vec![0; 3]].concat()).expect("written anew");
        let again: Vec<_> = (1..=RECHECK)
            .filter_map(|k| camera.next_picture(1 + k * SCAN_EVERY_NS).expect("readable"))
            .map(|(clues, _)| clues.number)
            .collect();
        assert_eq!(again, [None], "once, and its number says nothing");
    }
}
