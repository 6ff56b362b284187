//! What lies on a card beside pictures that are read: formats of phones, raw pictures and films, counted and named with the way to use them.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

/// A kind of file that is not read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Phone,
    Raw,
    Film,
}

impl Kind {
    fn of(extension: &str) -> Option<Self> {
        Some(match extension {
            "heic" | "heif" | "hif" | "avif" | "jxl" => Self::Phone,
            "dng" | "cr2" | "cr3" | "nef" | "arw" | "raf" | "rw2" | "orf" | "gpr" | "raw" | "3fr" | "iiq" => Self::Raw,
            "mp4" | "mov" | "m4v" | "avi" | "mts" | "insv" => Self::Film,
            _ => return None,
        })
    }

    /// What they are, and how they are made into pictures.
    fn advice(self, first: &Path) -> String {
        let name = |extension: &str| first.with_extension(extension).to_string_lossy().into_owned();
        match self {
            Self::Phone => "not read; `magick mogrify -format jpg *.HEIC` makes JPEGs that keep their positions".to_owned(),
            Self::Raw => {
                "raw, not read; use the JPEGs of the same shots, or develop all alike to JPEG or TIFF with their EXIF (RawTherapee, darktable)".to_owned()
            }
            Self::Film => format!(
                "films, not read; a picture a second of the first: `ffmpeg -i {} -vf fps=1 -q:v 2 {}`; positions come from {}, where the aircraft wrote one",
                first.display(),
                name("").trim_end_matches('.').to_owned() + "_%05d.jpg",
                name("SRT"),
            ),
        }
    }
}

/// Files that are not read.
#[derive(Debug, Default)]
pub(super) struct Unread(BTreeMap<Kind, Vec<PathBuf>>);

impl Unread {
    /// Counts `path`, where it is of a known kind.
    pub(super) fn add(&mut self, path: &Path) {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        if let Some(kind) = Kind::of(&extension) {
            self.0.entry(kind).or_default().push(path.to_owned());
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// One line for each kind; raw pictures and films that `pictures` were made of need none.
    pub(super) fn lines(&self, pictures: &[PathBuf]) -> Vec<String> {
        let stem = |path: &Path| path.with_extension("").to_string_lossy().to_lowercase();
        let read: HashSet<String> = pictures.iter().map(|p| stem(p)).collect();
        // FILM_00001.jpg
        let frames: HashSet<String> = pictures
            .iter()
            .map(|p| stem(p).trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches('_').to_owned())
            .collect();
        let is_used = |kind: Kind, path: &Path| match kind {
            Kind::Film => frames.contains(&stem(path)),
            _ => read.contains(&stem(path)),
        };
        let line = |(kind, paths): (&Kind, &Vec<PathBuf>)| {
            let mut left: Vec<&PathBuf> = paths.iter().filter(|path| !is_used(*kind, path)).collect();
            left.sort();
            let first = left.first()?;
            let more = if left.len() > 1 { ", …" } else { "" };
            let names = first.file_name().unwrap_or_default().to_string_lossy();
            Some(format!("{} files ({names}{more}): {}", left.len(), kind.advice(first)))
        };
        self.0.iter().filter_map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_read_is_named_with_the_way_to_use_it_unless_it_was_used() {
        let mut unread = Unread::default();
        for name in ["c/IMG_1.HEIC", "c/IMG_2.heic", "c/DJI_1.DNG", "c/DJI_2.DNG", "c/DJI_3.MP4", "c/a.txt"] {
            unread.add(Path::new(name));
        }
        let lines = unread.lines(&["c/DJI_1.JPG".into()]);
        assert_eq!(lines.len(), 3, "{lines:?}");
        assert!(lines[0].starts_with("2 files (IMG_1.HEIC, …)") && lines[0].contains("magick"), "{lines:?}");
        assert!(lines[1].starts_with("1 files (DJI_2.DNG)"), "{lines:?}");
        assert!(lines[2].contains("fps=1 -q:v 2 c/DJI_3_%05d.jpg`") && lines[2].contains("c/DJI_3.SRT"), "{lines:?}");
        let lines = unread.lines(&["c/dji_1.jpg".into(), "c/DJI_2.jpg".into(), "c/DJI_3_00001.jpg".into()]);
        assert_eq!(lines.len(), 1, "{lines:?}");
        assert!(Unread::default().is_empty() && !unread.is_empty());
    }
}
