//! Which files below a few folders may be pictures.

use std::collections::HashSet;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::error::CardError;
use super::unread::Unread;

/// Pictures read below the folders given; more is no card.
const MAX_FILES: usize = 200_000;
/// Names of any kind listed below the folders given: a card's thumbnails, logs and films beside its pictures, and no system's disk.
const MAX_NAMES: usize = 5 * MAX_FILES;
/// `DCIM/100MEDIA/…` is two deep; nobody's survey is deeper than this.
const MAX_DEPTH: usize = 12;
/// Folders of previews, masks, and what operating systems and other programs leave behind.
const SKIPPED: [&str; 7] =
    ["masks", "thm", "thumbnails", "@eadir", "__macosx", "$recycle.bin", "system volume information"];
/// Files of positions that are found by their names.
const GEOTAGS: [&str; 3] = ["geo.txt", "geotags.csv", "location.txt"];
/// Pictures are found by their names' ends; what they are is told by their content.
const PICTURES: [&str; 7] = [".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".webp"];

/// Surveyed points are found by this name.
const CONTROL: &str = "gcp_list.txt";

/// What was found.
#[derive(Debug, Default)]
pub(super) struct Scanned {
    /// Files with the extension of a picture, by path.
    pub files: Vec<PathBuf>,
    /// Files of positions.
    pub geotags: Vec<PathBuf>,
    /// Files of surveyed points.
    pub control: Vec<PathBuf>,
    /// Subtitles of films.
    pub subtitles: Vec<PathBuf>,
    /// Files of other kinds.
    pub unread: Unread,
    /// One line per folder that could not be read, or for a bound that was met.
    pub notes: Vec<String>,
    /// Device and number of the folders looked through: one may be given twice, or lie below another.
    looked_through: HashSet<(u64, u64)>,
    /// Links to folders, which are not followed: one may lead to a whole disk.
    links: Vec<PathBuf>,
    /// Names of any kind so far.
    names: usize,
}

/// Looks through `folders`; a folder given by name must be readable, one below it is passed over with a line.
pub(super) fn pictures(folders: &[PathBuf]) -> Result<Scanned, CardError> {
    let mut found = Scanned::default();
    for folder in folders {
        if let Err(source) = walk(folder, 0, &mut found) {
            return Err(CardError::Folder { path: folder.clone(), source });
        }
    }
    found.files.sort();
    found.files.dedup();
    if let Some(first) = found.links.first() {
        let more = found.links.len() - 1;
        let more = if more == 0 { String::new() } else { format!(", nor are {more} more") };
        found.notes.push(format!(
            "{}: a link to a folder, which is not followed{more}; give that folder as well if it belongs to the survey",
            first.display()
        ));
    }
    let names: HashSet<PathBuf> = found.files.iter().map(|f| f.with_extension("")).collect();
    found.files.retain(|file| !is_mask(file, &names));
    found.geotags.sort();
    found.geotags.dedup();
    found.control.sort();
    found.subtitles.sort();
    Ok(found)
}

/// OpenDroneMap's way: `a_mask.png` beside `a.jpg`. A picture that happens to have such a name stays one.
fn is_mask(file: &Path, pictures: &HashSet<PathBuf>) -> bool {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let picture = stem.len().checked_sub("_mask".len()).and_then(|end| {
        let (picture, marked) = stem.split_at_checked(end)?;
        marked.eq_ignore_ascii_case("_mask").then_some(picture)
    });
    picture.is_some_and(|picture| pictures.contains(&file.with_file_name(picture)))
}

fn walk(folder: &Path, depth: usize, found: &mut Scanned) -> std::io::Result<()> {
    let at = fs::metadata(folder)?;
    if !found.looked_through.insert((at.dev(), at.ino())) {
        return Ok(());
    }
    let mut folders = Vec::new();
    for entry in fs::read_dir(folder)? {
        let Ok(entry) = entry else { continue };
        if found.names == MAX_NAMES {
            found.notes.push(format!("{}: only the first {MAX_NAMES} names are listed", folder.display()));
            return Ok(());
        }
        found.names += 1;
        let name = entry.file_name().to_string_lossy().to_lowercase();
        if name.starts_with('.') {
            continue;
        }
        // A pipe or socket is no picture and is never opened.
        let Ok(kind) = entry.file_type() else { continue };
        let path = entry.path();
        let is_link = kind.is_symlink();
        if is_link && path.is_dir() {
            found.links.push(path);
        } else if kind.is_dir() {
            if depth < MAX_DEPTH && !SKIPPED.contains(&name.as_str()) {
                folders.push(path);
            }
        } else if kind.is_file() || (is_link && path.is_file()) {
            if GEOTAGS.contains(&name.as_str()) {
                found.geotags.push(path);
            } else if name == CONTROL {
                found.control.push(path);
            } else if name.ends_with(".srt") {
                found.subtitles.push(path);
            } else if PICTURES.iter().any(|e| name.ends_with(e)) {
                if found.files.len() == MAX_FILES {
                    found.notes.push(format!("{}: only the first {MAX_FILES} pictures are read", folder.display()));
                    return Ok(());
                }
                found.files.push(path);
            } else {
                found.unread.add(&path);
            }
        }
    }
    folders.sort();
    for below in folders {
        if found.names == MAX_NAMES {
            break;
        }
        if let Err(e) = walk(&below, depth + 1, found) {
            found.notes.push(format!("{}: cannot be read ({e}) and is passed over", below.display()));
        }
    }
    Ok(())
}
