//! Cameras with several eyes: bands of a multispectral camera, a thermal or zoom lens beside a wide one. Their pictures lie on one card and
//! show different light, so that one kind of them makes a model.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::error::CardError;
use super::record::{Eye, Record};

/// Colours as people see them.
const RGB: &str = "RGB";
/// Endings of file names (Parrot Sequoia, DJI Mavic 3M, DJI H20 to M30, FLIR) and what they mean.
const ENDINGS: [(&str, &str); 18] = [
    ("_ms_nir", "NIR"),
    ("_ms_re", "RedEdge"),
    ("_ms_r", "Red"),
    ("_ms_g", "Green"),
    ("_ms_b", "Blue"),
    ("_thrm", "thermal"),
    ("_rgb", RGB),
    ("_gre", "Green"),
    ("_red", "Red"),
    ("_reg", "RedEdge"),
    ("_nir", "NIR"),
    ("_ir", "thermal"),
    ("_d", RGB),
    ("_w", "wide"),
    ("_z", "zoom"),
    ("_v", "visible"),
    ("_t", "thermal"),
    ("_s", "visible"),
];
/// DJI's names of lenses.
const SOURCES: [(&str, &str); 5] = [
    ("widecamera", "wide"),
    ("zoomcamera", "zoom"),
    ("infraredcamera", "thermal"),
    ("thermalcamera", "thermal"),
    ("visiblecamera", "visible"),
];
/// Kinds that show what people see, the usual one first.
const COLORED: [&str; 4] = [RGB, "wide", "visible", "zoom"];
/// A kind of fewer pictures than this share of the largest is not taken unasked: a few test shots.
const FEW: f64 = 0.25;
/// A second eye whose pictures have no more than this share of the other's pixels is another sensor, not another setting.
const SMALLER: f64 = 0.25;
/// Two eyes of one camera release within this, nanoseconds.
const TOGETHER_NS: u64 = 2_000_000_000;
/// So many of a kind have a counterpart of the other kind, where they are two eyes of one camera.
const PAIRED: f64 = 0.8;

/// Keeps the pictures of one kind: those called `wanted`, else those of natural colours, else the most; one line where there were several.
///
/// # Errors
/// There is no kind called `wanted`.
pub(super) fn choose(
    folder: &Path,
    records: &mut Vec<Record>,
    wanted: Option<&str>,
    lines: &mut Vec<String>,
) -> Result<(), CardError> {
    let labels = labels(records);
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    labels.iter().for_each(|label| *counts.entry(label).or_default() += 1);
    let spelt = |name: &str, n: &usize| format!("{name} ({n})");
    let list = counts.iter().map(|(name, n)| spelt(name, n)).collect::<Vec<_>>().join(", ");
    let taken = match wanted {
        Some(wanted) => {
            let found = counts.keys().find(|name| plain(name) == plain(wanted));
            found.copied().ok_or_else(|| CardError::NoBand {
                path: folder.to_owned(),
                wanted: wanted.to_owned(),
                known: list.clone(),
            })?
        }
        None if counts.len() < 2 => return Ok(()),
        None => {
            let most = counts.values().copied().max().unwrap_or(0);
            let enough = |name: &&&str| counts.get(**name).is_some_and(|n| *n as f64 >= FEW * most as f64);
            let largest = counts.iter().rev().max_by_key(|(_, n)| **n).map(|(name, _)| *name);
            COLORED.iter().find(enough).copied().or(largest).unwrap_or(RGB)
        }
    };
    if counts.len() > 1 {
        lines.push(format!(
            "pictures of {} kinds, which show different light: {list}; {taken} is taken (--band NAME takes another)",
            counts.len()
        ));
    }
    let taken = taken.to_owned();
    let mut label = labels.iter();
    records.retain(|_| label.next().is_some_and(|label| *label == taken));
    Ok(())
}

/// Upper case without what people leave out or put between.
fn plain(name: &str) -> String {
    name.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

/// The kind of every picture.
fn labels(records: &[Record]) -> Vec<String> {
    let endings = endings(records);
    let mut labels: Vec<Option<String>> =
        records.iter().zip(endings).map(|(r, ending)| stated(&r.eye).or(ending.map(str::to_owned))).collect();
    let mixed = records.iter().any(|r| r.eye.is_grey) && records.iter().any(|r| !r.eye.is_grey);
    for (i, band) in numbered(records, &labels) {
        labels[i] = Some(band);
    }
    if labels.iter().all(Option::is_none) && !mixed {
        return by_size(records);
    }
    let bare = |r: &Record| if r.eye.is_grey && mixed { "grey" } else { RGB };
    labels.into_iter().zip(records).map(|(label, r)| label.unwrap_or_else(|| bare(r).to_owned())).collect()
}

fn stated(eye: &Eye) -> Option<String> {
    let stated = eye.stated.as_deref()?.trim();
    let known = SOURCES.iter().find(|(name, _)| plain(stated) == *name);
    match known {
        Some((_, label)) => Some((*label).to_owned()),
        // "Red,Green,Blue".
        None if stated.contains(',') => Some(RGB.to_owned()),
        None => (!stated.is_empty() && plain(stated) != "default").then(|| stated.to_owned()),
    }
}

/// Folder, and the number that a file's name has before its ending.
fn number_before(path: &Path, ending: &str) -> Option<(PathBuf, String)> {
    let stem = path.file_stem()?.to_string_lossy().to_lowercase();
    let before = stem.strip_suffix(ending)?;
    let digits = before.chars().rev().take_while(char::is_ascii_digit).count();
    let number = before.get(before.len() - digits..)?;
    (digits > 0).then(|| (path.parent().map(Path::to_owned).unwrap_or_default(), number.to_owned()))
}

/// What the endings of names mean, where the same number has another ending, too.
fn endings(records: &[Record]) -> Vec<Option<&'static str>> {
    let of = |r: &Record| {
        let stem = r.path.file_stem()?.to_string_lossy().to_lowercase();
        let (ending, label) = ENDINGS.iter().find(|(ending, _)| stem.ends_with(ending))?;
        Some((number_before(&r.path, ending)?, *label))
    };
    let mut eyes: HashMap<(PathBuf, String), HashSet<&str>> = HashMap::new();
    for r in records {
        if let Some((key, label)) = of(r) {
            eyes.entry(key).or_default().insert(label);
        } else if let Some(key) = number_before(&r.path, "") {
            eyes.entry(key).or_default().insert("");
        }
    }
    let twins: Vec<Option<(&str, bool)>> = records
        .iter()
        .map(|r| of(r).map(|(key, label)| (label, eyes.get(&key).is_some_and(|labels| labels.len() > 1))))
        .collect();
    let mut shares: HashMap<&str, (usize, usize)> = HashMap::new();
    for (label, paired) in twins.iter().flatten() {
        let share = shares.entry(label).or_default();
        *share = (share.0 + usize::from(*paired), share.1 + 1);
    }
    let means = |label: &str| shares.get(label).is_some_and(|(paired, all)| 2 * paired >= *all);
    twins.into_iter().map(|twin| twin.map(|(label, _)| label).filter(|label| means(label))).collect()
}

/// Grey pictures without a word about their band: by the number behind their shot's (MicaSense, `IMG_0007_3.tif`), or the last digit of
/// their own (DJI P4 Multispectral, `DJI_0013.TIF`). Serial numbers do not tell: two aircraft are no two bands.
fn numbered(records: &[Record], labels: &[Option<String>]) -> Vec<(usize, String)> {
    let unnamed: Vec<usize> = (0..records.len()).filter(|&i| labels[i].is_none() && records[i].eye.is_grey).collect();
    let stem = |i: usize| records[i].path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let behind = |i: usize| {
        let stem = stem(i);
        let (shot, band) = stem.rsplit_once('_')?;
        let numbered = shot.ends_with(|c: char| c.is_ascii_digit()) && band.len() <= 2;
        numbered.then(|| band.parse::<u8>().ok()).flatten().filter(|n| *n > 0).map(|n| n.to_string())
    };
    let last = |i: usize| stem(i).chars().last().filter(|c| ('1'..='6').contains(c)).map(String::from);
    let candidates: [&dyn Fn(usize) -> Option<String>; 2] = [&behind, &last];
    for of in candidates {
        let Some(bands) = unnamed.iter().map(|&i| of(i)).collect::<Option<Vec<_>>>() else { continue };
        let mut counts: HashMap<&String, usize> = HashMap::new();
        bands.iter().for_each(|band| *counts.entry(band).or_default() += 1);
        let (least, most) = (counts.values().min().copied(), counts.values().max().copied());
        // Every release gives a picture of each band.
        let even = least.zip(most).is_some_and(|(least, most)| least >= 2 && least as f64 >= PAIRED * most as f64);
        if (2..=10).contains(&counts.len()) && even {
            return unnamed.iter().zip(bands).map(|(i, band)| (*i, format!("band {band}"))).collect();
        }
    }
    Vec::new()
}

/// Two eyes of one camera that nothing names: small pictures taken together with large ones.
fn by_size(records: &[Record]) -> Vec<String> {
    let size = |r: &Record| {
        let (w, h) = r.lens.size.unwrap_or((1, 1));
        (w.max(h), w.min(h))
    };
    let pixels = |(w, h): (u32, u32)| f64::from(w) * f64::from(h);
    let one = || vec![RGB.to_owned(); records.len()];
    let Some(largest) = records.iter().map(size).max_by(|a, b| pixels(*a).total_cmp(&pixels(*b))) else { return one() };
    let is_small = |r: &Record| pixels(size(r)) <= SMALLER * pixels(largest);
    let mut times: Vec<u64> = records.iter().filter(|r| !is_small(r)).filter_map(|r| Some(r.time_ns?.0)).collect();
    times.sort_unstable();
    let together = |r: &&Record| {
        let Some((time, _)) = r.time_ns else { return false };
        let at = times.partition_point(|t| t.saturating_add(TOGETHER_NS) < time);
        times.get(at).is_some_and(|t| t.abs_diff(time) <= TOGETHER_NS)
    };
    let small: Vec<&Record> = records.iter().filter(|r| is_small(r)).collect();
    let paired = small.iter().filter(|r| together(r)).count();
    if small.is_empty() || (paired as f64) < PAIRED * small.len() as f64 {
        return one();
    }
    let name = |r: &Record| {
        let (w, h) = size(r);
        if is_small(r) { format!("{w}x{h}") } else { RGB.to_owned() }
    };
    records.iter().map(name).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use geometry::lens::Distortion;
    use models::formats::reconstruction::{Focal, LensDescription};

    use super::*;

    fn record(path: &str, eye: Eye, size: (u32, u32), seconds: u64) -> Record {
        Record {
            name: path.to_owned(),
            path: path.into(),
            orientation: Default::default(),
            lens: LensDescription {
                size: Some(size),
                focal: Focal::Pixels(1000.0, 1000.0),
                principal: None,
                distortion: Distortion::default(),
            },
            focal_sigma: 0.1,
            time_ns: Some((seconds * 1_000_000_000, 1_000_000_000)),
            fix: None,
            relative_alt_m: None,
            attitude: None,
            course_deg: None,
            eye,
            mended: Vec::new(),
        }
    }

    fn stated(band: &str) -> Eye {
        Eye { stated: Some(band.to_owned()), is_grey: band != "Red,Green,Blue" }
    }

    fn grey() -> Eye {
        Eye { is_grey: true, ..Eye::default() }
    }

    /// Number of pictures that are taken, of which kind the first is, and the lines.
    fn taken(mut records: Vec<Record>, wanted: Option<&str>) -> Result<(usize, String, Vec<String>), String> {
        let mut lines = Vec::new();
        choose(Path::new("card"), &mut records, wanted, &mut lines).map_err(|e| e.to_string())?;
        assert!(lines.len() <= 1 && lines.iter().all(|l| !l.contains('\n')), "{lines:?}");
        Ok((records.len(), records[0].name.clone(), lines))
    }

    #[test]
    fn bands_are_told_by_their_names_and_the_colours_or_the_most_are_taken() {
        let small = (1280, 960);
        let sequoia = |n: u64| {
            [("GRE", "Green"), ("NIR", "NIR"), ("RGB", "Red,Green,Blue")]
                .map(|(end, band)| record(&format!("IMG_{n:04}_{end}.TIF"), stated(band), small, n))
        };
        let (n, first, lines) = taken((0..5).flat_map(sequoia).collect(), None).unwrap();
        assert_eq!((n, first.as_str()), (5, "IMG_0000_RGB.TIF"));
        assert!(lines[0].contains("Green (5), NIR (5), RGB (5); RGB is taken (--band"), "{lines:?}");
        assert_eq!(taken((0..5).flat_map(sequoia).collect(), Some("nir")).unwrap().1, "IMG_0000_NIR.TIF");
        let error = taken((0..5).flat_map(sequoia).collect(), Some("blue")).unwrap_err();
        assert!(error.contains("\"blue\"") && error.contains("Green (5)") && !error.contains('\n'), "{error}");
        // MicaSense: no colours, all bands alike.
        let edge = |n: u64| {
            ["Blue", "Green", "Red edge"].map(|band| record(&format!("IMG_{n:04}_{band}.tif"), stated(band), small, n))
        };
        assert_eq!(taken((0..5).flat_map(edge).collect(), Some("rededge")).unwrap().0, 5);
        assert_eq!(taken((0..5).flat_map(edge).collect(), None).unwrap().0, 5);
        // A few test shots in colour do not take the place of a survey.
        let shots = (90..92).map(|n| record(&format!("DJI_{n:04}.JPG"), Eye::default(), (4000, 3000), n));
        let mixed: Vec<Record> =
            shots.chain((0..9).map(|n| record(&format!("IMG_{n}.tif"), grey(), small, n))).collect();
        assert_eq!(taken(mixed, None).unwrap().0, 9);
    }

    #[test]
    fn endings_of_names_count_where_one_release_has_several() {
        let h20t = |n: u64| {
            [("W", (4056, 3040)), ("Z", (5184, 3888)), ("T", (640, 512))]
                .map(|(end, size)| record(&format!("DJI_2022061412{n:02}_{n:04}_{end}.JPG"), Eye::default(), size, n))
        };
        let (n, first, lines) = taken((0..4).flat_map(h20t).collect(), None).unwrap();
        assert!(
            n == 4 && first.ends_with("_W.JPG") && lines[0].contains("thermal (4), wide (4), zoom (4)"),
            "{lines:?}"
        );
        let alone: Vec<Record> =
            (0..4).map(|n| record(&format!("house_{n}_d.jpg"), Eye::default(), (400, 300), n)).collect();
        assert_eq!(taken(alone, None).unwrap(), (4, "house_0_d.jpg".to_owned(), Vec::new()));
    }

    #[test]
    fn bands_without_names_are_told_by_numbers_serials_and_sizes() {
        let micasense = |n: u64| [1, 2, 3].map(|k| record(&format!("IMG_{n:04}_{k}.tif"), grey(), (1280, 960), n));
        let (n, _, lines) = taken((0..4).flat_map(micasense).collect(), None).unwrap();
        assert!(n == 4 && lines[0].contains("band 1 (4), band 2 (4), band 3 (4)"), "{lines:?}");
        let p4m = |n: u64| {
            (0..6).map(move |k| {
                let (ext, eye) = if k == 0 { ("JPG", Eye::default()) } else { ("TIF", grey()) };
                record(&format!("DJI_{:04}.{ext}", 10 * n + k), eye, (1600, 1300), n)
            })
        };
        let (n, first, _) = taken((1..5).flat_map(p4m).collect(), None).unwrap();
        assert_eq!((n, first.as_str()), (4, "DJI_0010.JPG"));
        assert_eq!(taken((1..5).flat_map(p4m).collect(), Some("band 3")).unwrap().1, "DJI_0013.TIF");
        let dual = |n: u64| {
            [(2 * n, (4056, 3040)), (2 * n + 1, (640, 480))]
                .map(|(k, size)| record(&format!("DJI_{k:04}.JPG"), Eye::default(), size, 5 * n))
        };
        let (n, _, lines) = taken((0..4).flat_map(dual).collect(), None).unwrap();
        assert!(n == 4 && lines[0].contains("640x480 (4), RGB (4); RGB is taken"), "{lines:?}");
    }

    #[test]
    fn one_kind_of_picture_in_two_sizes_or_of_two_aircraft_is_one() {
        let two: Vec<Record> =
            (0..8).map(|n| record(&format!("{}/DJI_{n}.JPG", n % 2), Eye::default(), (4000, 3000), n)).collect();
        assert_eq!(taken(two, None).unwrap().0, 8);
        let scaled: Vec<Record> = (0..8)
            .map(|n| {
                record(&format!("{n}.jpg"), Eye::default(), if n < 4 { (4000, 3000) } else { (1000, 750) }, 60 * n)
            })
            .collect();
        assert_eq!(taken(scaled, None).unwrap().0, 8);
        let grey: Vec<Record> = (0..8).map(|n| record(&format!("scan_{n}.tif"), grey(), (4000, 3000), n)).collect();
        assert_eq!(taken(grey, None).unwrap().0, 8);
    }
}
