//! Whether the medium that a folder is on is still there. An unmounted mount point is an ordinary empty folder: what is written
//! there fills the disk below it, and nobody carries it anywhere.

use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Folders that hold nothing but mount points (Filesystem Hierarchy Standard 3.0, and udisks).
const MOUNT_FOLDERS: [&str; 3] = ["/media", "/run/media", "/mnt"];

/// The file system a folder is expected on.
#[derive(Debug)]
pub struct Medium {
    root: PathBuf,
    mount_folders: Vec<PathBuf>,
    /// The one it was on when it was used first.
    device: Option<u64>,
}

impl Medium {
    /// The medium of the folder `root`, which need not be there yet.
    pub fn of(root: &Path) -> Self {
        Self { root: root.into(), mount_folders: MOUNT_FOLDERS.map(PathBuf::from).to_vec(), device: None }
    }

    /// Its medium is there, and the one it was before.
    ///
    /// # Errors
    /// `NotFound`: it was unmounted, or never mounted.
    pub fn check(&mut self) -> io::Result<()> {
        let here = device_of(&self.root)?;
        let gone = |why: &str| {
            Err(io::Error::new(io::ErrorKind::NotFound, format!("{why}; mount the medium, or give another folder")))
        };
        if self.device.is_some_and(|before| before != here) {
            return gone("is on another file system than before, its medium was unmounted");
        }
        let holder = self.mount_folders.iter().find(|folder| self.root.starts_with(folder));
        if let Some(holder) = holder
            && device_of(holder)? == here
        {
            return gone("nothing is mounted there");
        }
        self.device = Some(here);
        Ok(())
    }
}

/// The file system of a folder, or of the nearest one above it that is there.
fn device_of(folder: &Path) -> io::Result<u64> {
    let there = folder.ancestors().find_map(|f| {
        let f = if f.as_os_str().is_empty() { Path::new(".") } else { f };
        f.metadata().ok()
    });
    there.map(|m| m.dev()).ok_or_else(|| io::Error::from(io::ErrorKind::NotFound))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_below_an_unmounted_mount_point_is_refused() {
        let media = tempfile::tempdir().expect("a folder");
        let stick = media.path().join("user/STICK");
        std::fs::create_dir_all(&stick).expect("a mount point");
        let medium = |root: &Path| Medium { root: root.into(), mount_folders: vec![media.path().into()], device: None };
        for root in [stick.clone(), stick.join("models")] {
            let error = medium(&root).check().expect_err("nothing is mounted there");
            assert!(error.to_string().contains("nothing is mounted"), "{error}");
        }
        // A file system of its own stands in for a mounted stick.
        let other = Path::new("/proc");
        assert!(Medium { root: other.into(), mount_folders: vec!["/".into()], device: None }.check().is_ok());
    }

    #[test]
    fn a_medium_that_was_there_and_is_not_any_more_is_noticed() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut medium = Medium::of(folder.path());
        medium.check().expect("an ordinary folder");
        medium.device = medium.device.map(|d| d + 1);
        let error = medium.check().expect_err("another file system");
        assert!(error.to_string().contains("unmounted"), "{error}");
    }
}
