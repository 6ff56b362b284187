//! The first guess of a lens, from the best that a picture says, and how far it may be wrong.

use exif::Tag;
use geometry::lens::Distortion;

use super::exif::Fields;
use super::xmp::{Maker, Xmp};
use models::formats::reconstruction::{Focal, LensDescription};

/// A maker's calibration of this very camera, of its model, EXIF's rounded focal length, and none at all: relative
/// standard deviations.
const CALIBRATED: f64 = 0.005;
const TYPICAL: f64 = 0.01;
const EXIF: f64 = 0.1;
const UNKNOWN: f64 = 0.3;
/// Diagonal of 36 mm × 24 mm film: EXIF's 35 mm equivalent compares diagonals (CIPA DCG-001).
const FILM_DIAGONAL_MM: f64 = 43.266_615;
/// A wide angle of 24 mm on film, which most survey cameras are near.
const USUAL_DIAGONALS: f64 = 24.0 / FILM_DIAGONAL_MM;

/// Lens at the stored size and the relative standard deviation of its focal length.
pub(super) fn guess((w, h): (u32, u32), exif: Option<&Fields>, xmp: &Xmp) -> (LensDescription, f64) {
    let (width, height) = (f64::from(w), f64::from(h));
    let lens = |fx: f64, fy: f64, principal, distortion| LensDescription {
        size: Some((w, h)),
        focal: Focal::Pixels(fx, fy),
        principal,
        distortion,
    };
    let calibrated = dewarp_data(xmp, width, height).or_else(|| perspective(exif, xmp, width, height));
    if let Some((focal, principal, distortion)) = calibrated {
        let found = lens(focal[0], focal[1], Some(principal), distortion);
        if found.fault().is_none() && plausible(focal[0], width) && plausible(focal[1], width) {
            return (found, CALIBRATED);
        }
    }
    let diagonal = sensor_diagonal(width.max(height), width.min(height));
    let pixels = |tag, unit: Option<f64>| Some(exif?.positive(tag)? / unit?);
    let unit_mm = exif.and_then(|e| match e.number(Tag::FocalPlaneResolutionUnit).unwrap_or(2.0) as u32 {
        2 => Some(25.4),
        3 => Some(10.0),
        4 => Some(1.0),
        5 => Some(1e-3),
        _ => None,
    });
    let by_plane = || {
        // The resolution is that of the sensor; a picture scaled down has fewer pixels than the tags speak of.
        let full = exif?.positive(Tag::PixelXDimension).filter(|x| *x >= width).unwrap_or(width);
        Some(exif?.positive(Tag::FocalLength)? * pixels(Tag::FocalPlaneXResolution, unit_mm)? * width / full)
    };
    let guesses = [
        (
            xmp.number(Maker::Dji, "CalibratedFocalLength").or(xmp.number(Maker::Skydio, "CalibratedFocalLength")),
            TYPICAL,
        ),
        (exif.and_then(|e| Some(e.positive(Tag::FocalLengthIn35mmFilm)? / FILM_DIAGONAL_MM * diagonal)), EXIF),
        (by_plane(), EXIF),
    ];
    let best = guesses.into_iter().find_map(|(f, sigma)| Some((f.filter(|f| plausible(*f, width))?, sigma)));
    let (f, sigma) = best.unwrap_or((USUAL_DIAGONALS * diagonal, UNKNOWN));
    (lens(f, f, None, Distortion::default()), sigma)
}

/// Diagonal of the sensor in pixels of the picture. Pictures wider than 3:2 are cut out of 4:3 sensors (drones and action
/// cameras, whose equivalent focal length stays that of the whole sensor); brighton_beach's is then 2.8 % off, not 11 %.
fn sensor_diagonal(longer: f64, shorter: f64) -> f64 {
    if longer > 1.55 * shorter { longer * 1.25 } else { longer.hypot(shorter) }
}

/// Between a lens of 157° and one of 3°; what lies outside is a mistake (a focal length in millimetres, zero, …).
fn plausible(focal: f64, width: f64) -> bool {
    (0.1 * width..20.0 * width).contains(&focal)
}

type Calibration = ([f64; 2], (f64, f64), Distortion);

/// DJI's factory calibration: `2019-05-02;fx,fy,cx,cy,k1,k2,p1,p2,k3`, in pixels of the full picture, the centre relative
/// to its middle, coefficients in OpenCV's order. Where the camera has undistorted the picture itself only the focal
/// length holds.
fn dewarp_data(xmp: &Xmp, width: f64, height: f64) -> Option<Calibration> {
    let text = xmp.text(Maker::Dji, "DewarpData")?;
    let values = text.rsplit(';').next()?.split(',').map(super::xmp::number).collect::<Option<Vec<_>>>()?;
    let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = values[..] else { return None };
    match xmp.number(Maker::Dji, "DewarpFlag") == Some(1.0) {
        true => Some(([fx, fy], (0.5 * width, 0.5 * height), Distortion::default())),
        false => Some((
            [fx, fy],
            (0.5 * width + cx, 0.5 * height + cy),
            Distortion { k1, k2, k3, p1, p2, ..Distortion::default() },
        )),
    }
}

/// Pix4D's perspective model, in millimetres on the sensor whose pixels EXIF's focal-plane resolution counts.
fn perspective(exif: Option<&Fields>, xmp: &Xmp, width: f64, height: f64) -> Option<Calibration> {
    if xmp.text(Maker::Pix4d, "ModelType").is_some_and(|m| !m.eq_ignore_ascii_case("perspective")) {
        return None;
    }
    let exif = exif?;
    let per_unit = |tag| exif.positive(tag);
    let unit_mm = match exif.number(Tag::FocalPlaneResolutionUnit)? as u32 {
        2 => 25.4,
        3 => 10.0,
        4 => 1.0,
        _ => return None,
    };
    let (x, y) = (per_unit(Tag::FocalPlaneXResolution)? / unit_mm, per_unit(Tag::FocalPlaneYResolution)? / unit_mm);
    let f = xmp.number(Maker::Pix4d, "PerspectiveFocalLength")?;
    let principal = match xmp.list(Maker::Pix4d, "PrincipalPoint").as_deref() {
        Some([cx, cy]) => (cx * x, cy * y),
        _ => (0.5 * width, 0.5 * height),
    };
    let distortion = match xmp.list(Maker::Pix4d, "PerspectiveDistortion").as_deref() {
        Some([k1, k2, k3, p1, p2]) => {
            Distortion { k1: *k1, k2: *k2, k3: *k3, p1: *p1, p2: *p2, ..Distortion::default() }
        }
        _ => Distortion::default(),
    };
    Some(([f * x, f * y], principal, distortion))
}
