//! A folder that another program writes pictures into. Files appear slowly, half written, out of order, under temporary
//! names; a picture is handed out once it is whole.

use std::collections::HashSet;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::exif::camera_clock;
use super::{Picture, is_complete};
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

struct Growing {
    path: PathBuf,
    size: u64,
    since_ns: u64,
}

/// A watched folder.
pub struct FolderCamera {
    folder: PathBuf,
    /// Hashes of the names that were handed out or given up.
    done: HashSet<u64>,
    growing: Vec<Growing>,
    /// Whole pictures waiting, the next one last.
    ready: Vec<(PictureClues, PathBuf)>,
    next_scan_ns: u64,
    /// Files arrive when they are seen, not when they were written.
    simulated_clock: bool,
}

fn key(path: &Path) -> u64 {
    let mut hasher = DefaultHasher::new();
    path.file_name().hash(&mut hasher);
    hasher.finish()
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
    /// As there.
    pub fn open_since(folder: &Path, since: Option<SystemTime>) -> Result<Self, HalError> {
        let mut camera = Self {
            folder: folder.into(),
            done: HashSet::new(),
            growing: Vec::with_capacity(MAX_GROWING),
            ready: Vec::new(),
            next_scan_ns: 0,
            simulated_clock: false,
        };
        let earlier = |path: &Path| {
            let written = path.metadata().and_then(|m| m.modified());
            since.is_none_or(|since| written.is_ok_and(|at| at <= since))
        };
        for path in camera.list()? {
            if earlier(&path) && is_complete(&path).unwrap_or(false) {
                camera.done.insert(key(&path));
            }
        }
        Ok(camera)
    }

    /// For a clock that is not the wall's: the age of a file says nothing then.
    pub fn on_simulated_clock(self) -> Self {
        Self { simulated_clock: true, ..self }
    }

    fn list(&self) -> Result<Vec<PathBuf>, HalError> {
        let wrong = |e: std::io::Error| HalError::Camera {
            what: format!("folder {}", self.folder.display()),
            why: format!("{e}; create it or correct the mission's camera"),
        };
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(&self.folder).map_err(wrong)? {
            let path = entry.map_err(wrong)?.path();
            if is_picture(&path) && !self.done.contains(&key(&path)) {
                paths.push(path);
            }
        }
        Ok(paths)
    }

    fn scan(&mut self, now_ns: u64) -> Result<(), HalError> {
        let mut broken = None;
        for path in self.list()? {
            // Gone again between listing and looking: renamed or deleted, the next scan knows.
            let Ok(meta) = path.metadata() else { continue };
            if is_complete(&path).unwrap_or(false) {
                self.growing.retain(|g| g.path != path);
                self.take(path, &meta, now_ns);
            } else if let Some(g) = self.growing.iter_mut().find(|g| g.path == path) {
                if g.size != meta.len() {
                    (g.size, g.since_ns) = (meta.len(), now_ns);
                } else if now_ns.saturating_sub(g.since_ns) > STALLED_NS {
                    self.done.insert(key(&path));
                    broken = Some(path);
                }
            } else if self.growing.len() < MAX_GROWING {
                self.growing.push(Growing { path, size: meta.len(), since_ns: now_ns });
            }
        }
        // By number, so that files that came within one scan are handed out in the camera's order.
        self.ready.sort_by(|(a, p), (b, q)| (b.number, q).cmp(&(a.number, p)));
        match broken {
            Some(path) => {
                self.growing.retain(|g| g.path != path);
                Err(HalError::Picture { path, why: "half written and no longer growing; left out".into() })
            }
            None => Ok(()),
        }
    }

    fn take(&mut self, path: PathBuf, meta: &std::fs::Metadata, now_ns: u64) {
        if self.done.len() >= MAX_FILES {
            return;
        }
        self.done.insert(key(&path));
        // When its last byte was written, on our clock; a clock that was set meanwhile counts for a scan at most.
        let age = meta.modified().ok().and_then(|m| SystemTime::now().duration_since(m).ok());
        let longest_ns = if self.simulated_clock { 0 } else { 2 * SCAN_EVERY_NS };
        let age_ns = age.map_or(0, |a| a.as_nanos() as u64).min(longest_ns);
        let (camera_ns, camera_resolution_ns) = camera_clock(&path).unzip();
        let clues = PictureClues {
            arrived_ns: now_ns.saturating_sub(age_ns),
            number: number_of(&path),
            camera_ns,
            stamped_ns: None,
            camera_resolution_ns: camera_resolution_ns.unwrap_or(0),
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
    fn a_missing_folder_is_named() {
        let error = FolderCamera::open(Path::new("/nonexistent/camera")).err().expect("missing");
        assert!(error.to_string().contains("/nonexistent/camera"));
    }
}
