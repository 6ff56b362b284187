//! `geotags.csv`: where every matched picture was taken, as the HAL measured it, before any refinement. One line per
//! picture, written at once; a line that a power cut tore is taken off at the next start. Surveyors feed such files to other tools.

use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use disk::{Disk, Lines};
use geometry::geodesy::{EnuFrame, Geodetic};
use hal::vehicle::PosedPicture;

use crate::capture::Decision;

/// Name in the output folder.
pub const FILE: &str = "geotags.csv";
/// Columns: angles in degrees, lengths in metres, camera (x right, y down, z forward) → east-north-up quaternion.
const HEADER: &str = "picture,sequence,lat_deg,lon_deg,alt_m,east_m,north_m,up_m,qw,qx,qy,qz,\
                      sigma_m,sigma_deg,speed_m_s,key_frame,confidence";

/// Lines that a power cut may take: a line is a hundred bytes, a sync tens of milliseconds on an SD card.
const SYNC_EVERY: u32 = 16;

/// The open file.
pub struct Geotags {
    path: PathBuf,
    file: Lines,
    frame: EnuFrame,
    /// The present line; reused.
    line: String,
    /// Lines since the last sync.
    unsynced: u32,
    /// Pictures that are missing, as the disk failed.
    missing: u64,
    /// That lines may be lost was said.
    warned: bool,
}

impl Geotags {
    /// Opens or continues the file in `out`.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn open(disk: &Disk, out: &Path, origin: Geodetic) -> io::Result<Self> {
        let path = out.join(FILE);
        let mut file = disk.append_lines(&path)?;
        if path.metadata().map_or(0, |m| m.len()) == 0 {
            file.write(format!("{HEADER}\n").as_bytes())?;
        }
        let (frame, line) = (EnuFrame::new(origin), String::with_capacity(512));
        Ok(Self { path, file, frame, line, unsynced: 0, missing: 0, warned: false })
    }

    /// Notes a matched picture. A full disk must not end a flight: the first failure is said, later ones are not.
    pub fn note(&mut self, frame: &PosedPicture, decision: Decision) {
        if let Err(e) = self.write(frame, decision) {
            self.missing += 1;
            if self.missing == 1 {
                tracing::warn!("{}", self.complaint("pictures are missing while this lasts", &e));
            }
            return;
        }
        self.unsynced += 1;
        if self.unsynced >= SYNC_EVERY {
            self.sync();
        }
    }

    fn sync(&mut self) {
        self.unsynced = 0;
        if let Err(e) = self.file.sync()
            && !std::mem::replace(&mut self.warned, true)
        {
            tracing::warn!("{}", self.complaint("its last lines may be lost", &e));
        }
    }

    fn complaint(&self, what: &str, e: &io::Error) -> String {
        format!("{}: {what}: {}", self.path.display(), disk::told(e))
    }

    fn write(&mut self, frame: &PosedPicture, decision: Decision) -> io::Result<()> {
        let (p, q) = (frame.pose.position, frame.pose.rotation);
        let at = self.frame.to_geodetic(p);
        let name = frame.picture.name();
        let largest = |sigma: [f32; 3]| sigma.into_iter().fold(0.0, f32::max);
        self.line.clear();
        let written = writeln!(
            self.line,
            "{},{},{:.9},{:.9},{:.3},{:.3},{:.3},{:.3},{:.6},{:.6},{:.6},{:.6},{:.3},{:.3},{:.2},{},{:.3}",
            disk::table::field(&name.file_name().unwrap_or(name.as_os_str()).to_string_lossy()),
            frame.sequence,
            at.lat_deg,
            at.lon_deg,
            at.alt_m,
            p.x,
            p.y,
            p.z,
            q.w,
            q.x,
            q.y,
            q.z,
            largest(frame.pose.position_sigma_m),
            largest(frame.pose.rotation_sigma_rad).to_degrees(),
            frame.speed_m_s,
            u8::from(decision == Decision::Key),
            frame.confidence,
        );
        written.map_err(io::Error::other)?;
        self.file.write(self.line.as_bytes())
    }
}

impl Drop for Geotags {
    fn drop(&mut self) {
        if self.unsynced > 0 {
            self.sync();
        }
        if self.missing > 0 {
            tracing::warn!("{}: {} pictures are missing, as its disk failed", self.path.display(), self.missing);
        }
    }
}

#[cfg(test)]
#[cfg(feature = "lab")]
mod tests {
    use std::path::PathBuf;
    use std::sync::Arc;
    use std::sync::atomic::AtomicU64;

    use disk::System;
    use disk::bounded::Bounded;
    use glam::{DQuat, DVec3};
    use hal::camera::Picture;
    use hal::vehicle::CameraPose;

    use super::*;
    use crate::power_cut::{Done, Recorder};

    const ORIGIN: Geodetic = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 500.0 };

    fn posed(name: &str, sequence: u32) -> PosedPicture {
        let pose = CameraPose {
            position: DVec3::new(1.0, 2.0, 30.0),
            rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0),
            position_sigma_m: [0.1, 0.1, 0.3],
            rotation_sigma_rad: [0.01; 3],
        };
        let picture = Picture::Path(PathBuf::from("/card").join(name));
        PosedPicture { sequence, time_ns: 0, pose, speed_m_s: 5.0, confidence: 1.0, picture }
    }

    /// Lines written behind the last sync.
    fn unsynced(done: &[Done<()>]) -> usize {
        let since = done.iter().rposition(|d| matches!(d, Done::Synced(_))).map_or(0, |at| at + 1);
        let lines = |d: &Done<()>| match d {
            Done::Wrote(_, bytes) => bytes.iter().filter(|b| **b == b'\n').count(),
            _ => 0,
        };
        done[since..].iter().map(lines).sum()
    }

    #[test]
    fn a_power_cut_takes_few_of_the_geotags_and_none_after_the_end() {
        let folder = tempfile::tempdir().expect("a folder");
        let recorder = Recorder::<()>::new(false);
        let disk = Disk::new(recorder.clone());
        let mut geotags = Geotags::open(&disk, folder.path(), ORIGIN).expect("a file");
        let mut done = recorder.take();
        for n in 0..100 {
            geotags.note(&posed("a.jpg", n), Decision::Key);
            done.extend(recorder.take());
            // The line of names before the first sync is one more.
            assert!(unsynced(&done) <= SYNC_EVERY as usize + 1, "{n}");
        }
        drop(geotags);
        done.extend(recorder.take());
        assert_eq!(unsynced(&done), 0);
        let written = std::fs::read_to_string(folder.path().join(FILE)).expect("read");
        assert_eq!(written.lines().count(), 101);
    }

    #[test]
    fn a_full_disk_leaves_whole_lines_only_and_those_that_have_room_later() {
        let folder = tempfile::tempdir().expect("a folder");
        let root = folder.path().canonicalize().expect("its path");
        let limit = Arc::new(AtomicU64::new(1000));
        let disk = Disk::new(Bounded::new(System, &root, limit));
        let mut geotags = Geotags::open(&disk, &root, ORIGIN).expect("a file");
        let long = format!("{}.jpg", "a".repeat(200));
        // Of every other picture the name is too long for what is left.
        for n in 0..40 {
            geotags.note(&posed(if n % 2 == 0 { "a.jpg" } else { &long }, n), Decision::Key);
        }
        let missing = geotags.missing as usize;
        let e = geotags.write(&posed(&long, 40), Decision::Key).expect_err("it is full");
        let line = geotags.complaint("pictures are missing", &e);
        assert!(line.starts_with(&root.join(FILE).display().to_string()) && line.contains("make room"), "{line}");
        drop(geotags);
        let written = std::fs::read_to_string(root.join(FILE)).expect("read");
        assert!(written.len() <= 1000 && written.ends_with('\n') && written.lines().count() > 3, "{written}");
        assert_eq!(written.lines().count() - 1 + missing, 40, "what is missing is counted");
        let columns = HEADER.split(',').count();
        assert!(written.lines().all(|line| line.split(',').count() == columns), "{written}");
        let last = written.lines().last().expect("a line");
        assert!(last.starts_with("a.jpg,"), "{last}");
    }

    #[test]
    fn a_pictures_name_is_one_field_of_one_line_whatever_is_in_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut geotags = Geotags::open(&Disk::default(), folder.path(), ORIGIN).expect("a file");
        let names = ["a,b.jpg", "a\nb,1,2.jpg", "=HYPERLINK(\"x\").jpg", "-rf.jpg", "a\"b.jpg", "\u{1b}[31m.jpg"];
        for (name, n) in names.into_iter().zip(0..) {
            geotags.note(&posed(name, n), Decision::Key);
        }
        drop(geotags);
        let written = std::fs::read_to_string(folder.path().join(FILE)).expect("read");
        let mut lines = written.lines();
        let columns = lines.next().expect("names of the columns").split(',').count();
        for (n, line) in lines.enumerate() {
            assert!(!line.starts_with(['=', '+', '-', '@']) && !line.starts_with("\"="), "{line}");
            assert!(!line.contains(char::is_control), "{line:?}");
            // Outside of quotation marks.
            let fields: usize = 1 + line.split('"').step_by(2).map(|part| part.matches(',').count()).sum::<usize>();
            assert_eq!(fields, columns, "{line}");
            let rest = line.rsplitn(columns, ',').nth(columns - 2).expect("its number");
            assert_eq!(rest, n.to_string(), "{line}");
        }
        assert_eq!(written.lines().count(), 1 + names.len());
    }
}
