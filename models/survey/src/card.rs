//! A card of pictures as it comes out of an aircraft: JPEG, PNG and TIFF files in nested folders, and what they say about
//! where they were taken. What leaves this module are *priors with covariances*; where they came from is its business
//! alone. Contradictions are found by vote, corrected or down-weighted, and named, never fatal.
//!
//! | source | position | height | attitude | lens |
//! |---|---|---|---|---|
//! | EXIF | `GPSLatitude`, `GPSLongitude` (±`GPSHPositioningError`, else 1.5 m × `GPSDOP`, else 3 m) | `GPSAltitude` with `GPSAltitudeRef` | heading from `GPSImgDirection` (10°), else `GPSTrack` (30°), else course over ground (30°); nadir assumed (10°) | `FocalLengthIn35mmFilm`, else `FocalLength` with `FocalPlaneXResolution` (10 %) |
//! | DJI maker note (Phantom) | – | – | `CameraYaw/Pitch/Roll`, −90° = nadir | – |
//! | DJI `drone-dji:` | `GpsLatitude`/`Latitude`, ±`RtkStdLat/Lon`, else by `RtkFlag` (50 fixed, 34 float, 16 single) | `AbsoluteAltitude` ±`RtkStdHgt`; `RelativeAltitude` above take-off | `GimbalYaw/Pitch/RollDegree`, −90° = nadir; without a gimbal's `FlightYaw/Pitch/RollDegree` (10°) | `DewarpData` `date;fx,fy,cx,cy,k1,k2,p1,p2,k3`, centre relative to the middle (0.5 %; only the focal length where `DewarpFlag` says that the picture is already undistorted); `CalibratedFocalLength` (1 %) |
//! | Parrot `drone-parrot:` | – | `RelativeAltitude`… as DJI | `CameraYaw/Pitch/RollDegree`, −90° = nadir; else `DroneYaw/Pitch/RollDegree` (10°) | – |
//! | Skydio `drone-skydio:` | `Latitude`, `Longitude` | `AbsoluteAltitude`, `RelativeAltitude` | `CameraOrientationNEDYaw/Pitch/Roll`, −90° = nadir | `CalibratedFocalLength` |
//! | Pix4D `Camera:` (senseFly, Sequoia, MicaSense, Autel, Yuneec, Sentera) | ±`GPSXYAccuracy` | ±`GPSZAccuracy` | `Yaw/Pitch/Roll`, 0° = nadir with the heading at the top of the picture; a pitch below −45° (Autel) is taken as −90° = nadir; senseFly's roll has the other sign | `PerspectiveFocalLength` (mm), `PerspectiveDistortion` r1 r2 r3 t1 t2, `PrincipalPoint` (mm) |
//! | `geo.txt` (OpenDroneMap), Pix4D's list, tables with named columns | as stated, with its accuracies | as stated | yaw, pitch, roll: 0° = nadir in `geo.txt` | – |
//! | `gcp_list.txt` | surveyed points marked in pictures: they hold the poses, and give a card without GPS its place, north and scale; those named `CHK` measure the model instead | as stated | – | – |
//! | flight log | at the exposure, 1.5 m | as logged | the airframe's (10°), the gimbal's where logged (3°) | – |

use std::path::{Path, PathBuf};

use geometry::geodesy::{EnuFrame, Geodetic};

mod container;
pub mod control;
mod error;
mod exif;
pub mod exposures;
pub mod geotags;
mod groups;
mod lens;
pub mod log;
mod maker_note;
mod notes;
mod priors;
mod record;
mod scan;
mod sources;
mod subtitles;
mod unread;
mod vote;
pub mod write;
mod xmp;

pub use error::CardError;
pub use exposures::Exposure;
pub use log::{FlightLog, Series, Source};
pub use notes::name_list;
pub use priors::CardPicture;
pub use record::{Attitude, AttitudeSource, Fix, Record, nadir_rotation};

/// An opened card.
#[derive(Clone, Debug)]
pub struct Card {
    /// In order of capture: by time where known, else by name.
    pub pictures: Vec<CardPicture>,
    /// Origin of the priors' east-north-up frame; its height is that of the ground as far as anything tells it. `None` where no
    /// picture says where it was taken: then the priors have no positions, and the pictures tell the scene up to a similarity.
    pub origin: Option<Geodetic>,
    /// Surveyed points that were marked in pictures.
    pub control: Vec<control::SurveyedPoint>,
    /// Others, that the result is measured against and that are not used for it.
    pub check: Vec<control::SurveyedPoint>,
    /// One line per thing a user should know: what was left out and why, what contradicts the rest.
    pub notes: Vec<String>,
    /// One line per file of positions or surveyed points all of which was used, and per choice among pictures of several kinds.
    pub read: Vec<String>,
    /// Names with the extension of a picture that were found.
    pub found: usize,
}

/// What a card is read with besides its own files.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CardOptions {
    /// A file of positions (`geo.txt`, Pix4D's list, a table with named columns); files of these names on the card are found
    /// without it.
    pub geotags: Option<PathBuf>,
    /// A file of surveyed points (`gcp_list.txt`); one of this name on the card is found without it.
    pub control: Option<PathBuf>,
    /// A file of the same form, of points that the result is measured against.
    pub check: Option<PathBuf>,
    /// A flight log, whose exposures the pictures are matched to.
    pub log: Option<log::FlightLog>,
    /// The band or lens whose pictures are taken, where a camera has several.
    pub band: Option<String>,
}

/// A card's surveyed points: those that hold the poses, and those that measure what comes out.
struct Lists {
    control: Vec<control::SurveyedPoint>,
    check: Vec<control::SurveyedPoint>,
}

/// Reads the lists that were given and those that lie among the pictures; a point counts once, and never both ways.
fn surveyed(
    options: &CardOptions,
    marked: &[PathBuf],
    records: &[record::Record],
    lines: &mut Vec<String>,
    read: &mut Vec<String>,
) -> Result<Lists, CardError> {
    let mut of_file = |file: &Path, lines: &mut Vec<String>| -> Result<Vec<control::SurveyedPoint>, CardError> {
        let mut points = control::read(file)?;
        let (line, is_whole) = control::summary(file, &points, records);
        if is_whole { &mut *read } else { &mut *lines }.push(line);
        sources::judge_points(file, &mut points, records, lines)?;
        Ok(points)
    };
    let real = |file: &PathBuf| file.canonicalize().unwrap_or_else(|_| file.clone());
    let asked: Vec<PathBuf> = options.control.iter().chain(&options.check).map(real).collect();
    let found = marked.iter().filter(|file| !asked.contains(&real(file)));
    let (mut all, mut twice) = (Vec::new(), 0);
    for file in options.control.iter().chain(found) {
        twice += control::join(&mut all, of_file(file, lines)?);
    }
    let (mut check, mut control): (Vec<_>, Vec<_>) = all.into_iter().partition(control::SurveyedPoint::is_check);
    let named = (check.len(), control.len());
    if let Some(file) = &options.check {
        let points = of_file(file, lines)?;
        let held = control.extract_if(.., |held| points.iter().any(|p| p.is_at(held))).count();
        if held > 0 {
            lines.push(format!(
                "{}: {held} of its points are ground control, too; they hold nothing now",
                file.display()
            ));
        }
        twice += control::join(&mut check, points);
    }
    if twice > 0 {
        lines.push(format!("{twice} surveyed points are in more than one list; each counts once"));
    }
    match named {
        (0, _) => {}
        (n, 0) => {
            lines.push(format!("all {n} surveyed points are named CHK: they measure the model, and none holds it"))
        }
        (n, _) => read.push(format!("{n} surveyed points are named CHK: they measure the model and do not hold it")),
    }
    lines.extend(control::doubtful_names(&control));
    Ok(Lists { control, check })
}

impl Card {
    /// True when there is a file with the extension of a picture or a film below `folder`, or what kept such files from being found.
    pub fn has_pictures(folder: &Path) -> bool {
        let some =
            |found: scan::Scanned| !(found.files.is_empty() && found.unread.is_empty() && found.notes.is_empty());
        scan::pictures(&[folder.to_owned()]).is_ok_and(some)
    }

    /// Reads what the pictures below `folders` say of themselves; of no picture more than its head is read.
    ///
    /// # Errors
    /// A folder cannot be read, nothing in it is a picture, or a file of positions is bad.
    pub fn open(folders: &[PathBuf], options: &CardOptions) -> Result<Self, CardError> {
        let scanned = scan::pictures(folders)?;
        let scan::Scanned { files, notes: mut lines, geotags, control: marked, subtitles, unread, .. } = scanned;
        let first = folders.first().cloned().unwrap_or_default();
        let found = files.len();
        let unread = unread.lines(&files);
        let mut notes = notes::Notes::default();
        let mut records = record::read_all(files, &mut notes);
        if records.is_empty() {
            let why: Vec<String> = notes.summary().into_iter().chain(unread).chain(lines).collect();
            let why = if why.is_empty() { "there is none".to_owned() } else { why.join("; ") };
            return Err(CardError::NoPictures { path: first, why });
        }
        lines.extend(unread);
        let mut read = Vec::new();
        groups::choose(&first, &mut records, options.band.as_deref(), &mut read)?;
        for file in &subtitles {
            // Subtitles of a film that nobody took pictures of are nobody's business.
            lines.extend(subtitles::read(file).ok().and_then(|tags| geotags::apply_to_some(file, &tags, &mut records)));
        }
        for file in options.geotags.iter().chain(&geotags) {
            let is_film = file.extension().is_some_and(|e| e.eq_ignore_ascii_case("srt"));
            let tags = if is_film { subtitles::read(file)? } else { geotags::read(file)? };
            let (line, is_whole) = geotags::apply(file, &tags, &mut records)?;
            if is_whole { &mut read } else { &mut lines }.push(line);
        }
        if let Some(log) = &options.log {
            lines.push(log::apply(log, &mut records)?);
        }
        record::in_order(&mut records);
        sources::standing_still(&mut records, &mut lines, &mut notes);
        let Lists { control, check } = surveyed(options, &marked, &records, &mut lines, &mut read)?;
        if !records.iter().any(|r| r.fix.is_some()) {
            lines.push(format!(
                "none of {} pictures says where it was taken (no GPS in EXIF or XMP, no geotags): the scene has no place, no north and no scale (neighbours are 1 apart); --geotags or --log would give them",
                records.len()
            ));
            let pictures = priors::without_positions(&records);
            lines.extend(notes.lines());
            return Ok(Self { pictures, origin: None, control, check, notes: lines, read, found });
        }
        vote::settle(&mut records, &mut notes);
        let origin = priors::origin(&records);
        let pictures = priors::of(&records, &EnuFrame::new(origin), &mut notes);
        lines.extend(notes.lines());
        Ok(Self { pictures, origin: Some(origin), control, check, notes: lines, read, found })
    }
}
