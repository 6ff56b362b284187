//! Positions of a film's pictures, out of the subtitles that DJI's aircraft write beside it (`DJI_0001.SRT`). Frames are told by their
//! names: `ffmpeg -i DJI_0001.MP4 -vf fps=1 DJI_0001_%05d.jpg` takes one a second, the first at the film's begin.

use std::path::Path;

use geometry::geodesy::Geodetic;

use super::geotags::{Geotag, Geotags};
use super::record::{Attitude, AttitudeSource, Fix, GPS_SIGMA_M, UNKNOWN_HEIGHT_SIGMA_M};
use crate::coordinates::text;
use models::formats::FormatError;
use models::formats::telemetry::dji_rotation;

/// An hour at thirty lines of 400 bytes a second.
const LIMIT: u64 = 64 << 20;

/// Tags by the names that frames have when one is taken each second.
///
/// # Errors
/// The file cannot be read, or no position stands in it.
pub(super) fn read(path: &Path) -> Result<Geotags, FormatError> {
    let text = text(path, LIMIT)?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
    let (mut tags, mut next) = (Vec::new(), 0u64);
    // Blocks with an empty line between them: a number, `00:00:01,016 --> 00:00:01,033`, and what is shown.
    for block in text.replace('\r', "").split("\n\n") {
        let Some(start_ms) = block.lines().find_map(start_ms) else { continue };
        // The first that begins in a second stands for it.
        if start_ms / 1000 < next {
            continue;
        }
        let Some(tag) = tag(block) else { continue };
        let second = start_ms / 1000;
        tags.push((format!("{stem}_{:05}.jpg", second + 1), tag));
        next = second + 1;
    }
    match tags.is_empty() {
        true => Err(FormatError::invalid(path, "holds subtitles without positions")),
        false => Ok(Geotags { tags, doubt: None }),
    }
}

fn start_ms(line: &str) -> Option<u64> {
    let (start, _) = line.split_once("-->")?;
    let parts: Vec<u64> = start.trim().split([':', ',', '.']).map(|p| p.parse().ok()).collect::<Option<_>>()?;
    let [h, m, s, ms] = parts[..] else { return None };
    h.checked_mul(60)?.checked_add(m)?.checked_mul(60)?.checked_add(s)?.checked_mul(1000)?.checked_add(ms)
}

fn tag(block: &str) -> Option<Geotag> {
    // `[latitude: 46.84]`, `[rel_alt: 1.2 abs_alt: 198.3]`, `latitude : 46.84`; DJI writes "longtitude", too.
    let value = |name: &str| {
        block.match_indices(name).find_map(|(at, _)| {
            let before = block[..at].chars().next_back();
            let rest = block[at + name.len()..].trim_start().strip_prefix(':')?.trim_start();
            let end = rest.find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c))).unwrap_or(rest.len());
            let value: f64 = rest[..end].parse().ok()?;
            (!before.is_some_and(char::is_alphanumeric) && value.is_finite()).then_some(value)
        })
    };
    let any = |names: &[&str]| names.iter().find_map(|name| value(name));
    let place = any(&["latitude"]).zip(any(&["longitude", "longtitude"])).or_else(|| gps(block))?;
    let alt_m = any(&["abs_alt", "altitude"]);
    let position = Geodetic { lat_deg: place.0, lon_deg: place.1, alt_m: alt_m.unwrap_or_default() };
    if !position.is_valid() || place == (0.0, 0.0) {
        return None;
    }
    let angles = any(&["gb_yaw"]).zip(any(&["gb_pitch"])).zip(any(&["gb_roll"]));
    let attitude =
        angles.map(|((y, p), r)| Attitude { rotation: dji_rotation(y, p, r), source: AttitudeSource::Gimbal });
    let vertical = if alt_m.is_some() { GPS_SIGMA_M } else { UNKNOWN_HEIGHT_SIGMA_M };
    Some(Geotag { fix: Fix { position, sigma_m: [GPS_SIGMA_M, vertical] }, has_height: alt_m.is_some(), attitude })
}

/// `GPS(-91.99,46.84,19)` or `GPS (-91.99, 46.84, 19)`: longitude, latitude, satellites.
fn gps(block: &str) -> Option<(f64, f64)> {
    let (_, rest) = block.split_once("GPS")?;
    let (inside, _) = rest.trim_start().strip_prefix('(')?.split_once(')')?;
    let mut numbers = inside.split(',').map(|n| n.trim().parse::<f64>().ok());
    let (lon, lat) = (numbers.next()??, numbers.next()??);
    Some((lat, lon))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    #[test]
    fn each_second_of_a_film_has_the_place_that_its_subtitles_say() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("DJI_0001.SRT");
        let block = |n: u32, at: &str, said: &str| {
            format!("{n}\r\n{at} --> 00:01:00,000\r\n<font size=\"28\">{said}</font>\r\n\r\n")
        };
        let new = |lat: f64| {
            format!(
                "[iso: 100] [latitude: {lat}] [longitude: -91.99] [rel_alt: 40.1 abs_alt: 198.300] [gb_yaw: 90.0 gb_pitch: -90.0 gb_roll: 0.0]"
            )
        };
        let film = block(1, "00:00:00,000", &new(46.80))
            + &block(2, "00:00:00,500", &new(46.81))
            + &block(3, "00:00:01,000", &new(46.82))
            + &block(4, "00:00:02,016", &new(0.0).replace("-91.99", "0.0"))
            + &block(5, "00:00:02,033", &new(46.83));
        std::fs::write(&path, film).unwrap();
        let tags = read(&path).unwrap().tags;
        let names: Vec<(&str, f64)> = tags.iter().map(|(n, t)| (n.as_str(), t.fix.position.lat_deg)).collect();
        assert_eq!(
            names,
            [("dji_0001_00001.jpg", 46.80), ("dji_0001_00002.jpg", 46.82), ("dji_0001_00003.jpg", 46.83)]
        );
        assert_eq!((tags[0].1.fix.position.alt_m, tags[0].1.has_height), (198.3, true));
        assert!((tags[0].1.attitude.unwrap().rotation * glam::DVec3::Z).z < -0.999);
        std::fs::write(&path, block(1, "00:00:00,000", "HOME(-91,46) GPS(-91.5,46.5,19) BAROMETER:40.1")).unwrap();
        assert_eq!(read(&path).unwrap().tags[0].1.fix.position.lon_deg, -91.5);
        std::fs::write(&path, block(1, "00:00:00,000", "hello")).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("without positions"));
    }
}
