//! Projects of other photogrammetry programs as posed pictures: Metashape's cameras, RealityScan's table of cameras, Bundler's file and
//! Pix4D's OPF. Each is known by its content; each lens model is either understood or refused in one line.

use std::io::Read;
use std::path::{Path, PathBuf};

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DMat3, DQuat, DVec3};
use models::camera::Pose;
use models::formats::FormatError;
use models::formats::reconstruction::{Reconstruction, Shot};

mod bundler;
mod metashape;
mod opf;
mod realityscan;

/// Most names read in one folder.
const MOST_NAMES: usize = 10_000;
/// Bytes by which a file is known.
const HEAD: u64 = 4096;
/// Bytes of a project at most: a hundred thousand cameras of a kilobyte.
const LIMIT: u64 = 256 << 20;
/// Distances from the middle of the Earth at which cameras are, metres.
const FROM_EARTHS_MIDDLE: std::ops::Range<f64> = 6.30e6..6.45e6;

/// Width and height of the picture of a name, where it can be read.
pub(crate) type SizeOf<'a> = &'a mut dyn FnMut(&str) -> Option<(u32, u32)>;

/// A program's file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Metashape,
    RealityScan,
    Bundler,
    Opf,
}

/// The project in `root`, read; `None` where there is none. Of several the first by its name is read, and the others are named.
///
/// # Errors
/// A project is damaged, or speaks of lenses that are not known here.
pub(crate) fn find(root: &Path, size_of: SizeOf<'_>) -> Result<Option<Reconstruction>, FormatError> {
    let Ok(entries) = std::fs::read_dir(root) else { return Ok(None) };
    let mut paths: Vec<PathBuf> = entries.take(MOST_NAMES).flatten().map(|e| e.path()).collect();
    paths.sort();
    let mut found = paths.into_iter().filter_map(|path| kind(&path).map(|kind| (path, kind)));
    let Some((path, kind)) = found.next() else { return Ok(None) };
    let others: Vec<String> = found.map(|(path, _)| path.display().to_string()).collect();
    if !others.is_empty() {
        tracing::warn!("{} is read; {} left out", path.display(), others.join(", "));
    }
    let mut project = match kind {
        Kind::Metashape => metashape::read(&path)?,
        Kind::RealityScan => realityscan::read(&path, size_of)?,
        Kind::Bundler => bundler::read(&path)?,
        Kind::Opf => opf::read(&path)?,
    };
    if project.shots.is_empty() {
        return Err(FormatError::invalid(&path, "holds no camera that has a pose"));
    }
    check(&path, &project)?;
    onto_ground(&mut project);
    tracing::info!("{}: {} cameras", path.display(), project.shots.len());
    Ok(Some(project))
}

/// What a file is, by its name's end and its first bytes.
fn kind(path: &Path) -> Option<Kind> {
    let end = path.extension()?.to_str()?.to_ascii_lowercase();
    if !["xml", "csv", "out", "opf"].contains(&end.as_str()) {
        return None;
    }
    let mut head = Vec::new();
    disk::regular::open(path).ok()?.take(HEAD).read_to_end(&mut head).ok()?;
    let head = String::from_utf8_lossy(&head);
    let known = [
        ("xml", Kind::Metashape, metashape::is_one as fn(&str) -> bool),
        ("csv", Kind::RealityScan, realityscan::is_one),
        ("out", Kind::Bundler, bundler::is_one),
        ("opf", Kind::Opf, opf::is_one),
    ];
    known.into_iter().find(|(ends, _, is_one)| end == *ends && is_one(&head)).map(|(_, kind, _)| kind)
}

/// Every pose is one, and every lens could be one.
fn check(path: &Path, project: &Reconstruction) -> Result<(), FormatError> {
    for shot in &project.shots {
        let bad = |what: &str| FormatError::invalid(path, format!("{}: {what}", shot.path));
        if !(shot.pose.center.is_finite() && shot.pose.rotation.is_finite()) {
            return Err(bad("its pose is not a number"));
        }
        shot.lens.fault().map_or(Ok(()), |fault| Err(bad(fault)))?;
    }
    Ok(())
}

/// Poses around the middle of the Earth become east, north and up around the middle of the cameras.
fn onto_ground(project: &mut Reconstruction) {
    let count = project.shots.len() as f64;
    let middle = project.shots.iter().map(|s| s.pose.center).sum::<DVec3>() / count;
    if project.origin.is_some() || !FROM_EARTHS_MIDDLE.contains(&middle.length()) {
        return;
    }
    let origin = Geodetic::from_ecef(middle);
    let frame = EnuFrame::new(origin);
    for shot in &mut project.shots {
        let pose = &mut shot.pose;
        pose.center = frame.to_enu(Geodetic::from_ecef(pose.center));
        pose.rotation = (DQuat::from_mat3(&frame.axes()) * pose.rotation).normalize();
    }
    project.origin = Some(origin);
}

/// Whether a matrix only turns, to as many digits as files have.
fn is_rotation(matrix: DMat3) -> bool {
    let off = matrix * matrix.transpose() - DMat3::IDENTITY;
    off.to_cols_array().iter().all(|v| v.abs() < 1e-3) && matrix.determinant() > 0.0
}

/// A camera whose axes are those of OpenGL (right, up, backwards), with OpenCV's (right, down, forwards).
fn from_opengl(rotation: DMat3) -> DQuat {
    let turned = DMat3::from_cols(rotation.x_axis, -rotation.y_axis, -rotation.z_axis);
    DQuat::from_mat3(&turned).normalize()
}

fn shot(path: String, lens: models::formats::reconstruction::LensDescription, rotation: DQuat, center: DVec3) -> Shot {
    Shot { path, lens, pose: Pose { rotation, center }, mask: None }
}
