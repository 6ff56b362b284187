//! The mission file: one TOML file shared by every aircraft and the ground. It names the origin, who flies where,
//! the camera and its mount, and the budgets; each area's own settings live in its own module and appear here as
//! one table.
//!
//! Everything is checked once, on reading: what [`Mission::read`] returns needs no further validation.

use std::io::Read;
use std::path::{Path, PathBuf};

use crate::coverage::CoverageSettings;
use crate::failsafe::FailsafeSettings;
use crate::faults::FaultSettings;
use crate::ground::GroundSettings;
use crate::http::HttpSettings;
use crate::init::InitSettings;
use crate::keys::PublicKey;
use crate::link::LinkSettings;
use crate::map::MapSettings;
use crate::preset::Preset;
use crate::refine::RefineSettings;
use crate::settings::{Limits, SettingError, record, table};
use crate::survey::SurveySettings;
use crate::training::TrainSettings;
use crate::upload::UploadSettings;
use geometry::geodesy::{EnuFrame, Geodetic};

mod camera;
mod draft;
mod error;
mod keyframes;
mod memory;
mod origin;
mod reference;
mod validate;

pub use camera::{CameraSettings, CameraSource, MountAttitude, MountSettings};
pub use draft::{Draft, DraftArea};
pub use error::MissionError;
pub use keyframes::KeyframeSettings;
pub use memory::{DEVICE_MIB, MemorySettings};
pub use reference::reference;
pub use validate::{MAX_AIRCRAFT, MAX_CORNERS};

/// A mission file larger than this is refused before it is parsed: room for [`MAX_AIRCRAFT`] with a region of 64 corners each.
const MAX_FILE_BYTES: u64 = 4 << 20;

record! {
    /// What all aircraft and the ground share.
    pub struct Mission {
        /// Short name, part of every key on the wire: `[A-Za-z0-9_-]`, at most 32 characters.
        pub name: String;
        /// Seed of everything random: simulators, training, faults.
        #[serde(default)]
        pub seed: u64 = 0;
        /// Origin of the local East-North-Up frame.
        pub origin: Geodetic;
        /// Calibration of the camera, pixels of the full picture; the centre of the top-left pixel is at (0.5, 0.5).
        pub camera: CameraSettings;
        /// How the camera sits on the aircraft.
        #[serde(default)]
        pub mount: MountSettings = MountSettings::default();
        /// The link to the autopilot, signing, and how pictures are matched.
        #[serde(default)]
        pub link: LinkSettings = LinkSettings::default();
        /// When a picture becomes a key frame: it moved more than `t_min_m` or turned more than `r_max_deg`.
        #[serde(default)]
        pub keyframes: KeyframeSettings = KeyframeSettings::default();
        /// When a piece of ground counts as covered; what is missing is told after the landing, as a file and as a flight that gets it.
        #[serde(default)]
        pub coverage: CoverageSettings = CoverageSettings::default();
        /// The budgets everything is planned from.
        #[serde(default)]
        pub memory: MemorySettings = MemorySettings::default();
        /// Manifests of the user's own networks.
        #[serde(default)]
        pub network: NetworkSettings = NetworkSettings::default();
        /// How models travel from the aircraft to the ground.
        #[serde(default)]
        pub upload: UploadSettings = UploadSettings::default();
        /// How the ground merges and distils them.
        #[serde(default)]
        pub ground: GroundSettings = GroundSettings::default();
        /// How pictures become the first Gaussians.
        #[serde(default)]
        pub init: InitSettings = InitSettings::default();
        /// How telemetry's poses are refined.
        #[serde(default)]
        pub refine: RefineSettings = RefineSettings::default();
        /// The training recipe.
        #[serde(default)]
        pub training: TrainSettings = TrainSettings::default();
        /// When orthophoto and heights are drawn.
        #[serde(default)]
        pub map: MapSettings = MapSettings::default();
        /// Who may look at the live page.
        #[serde(default)]
        pub http: HttpSettings = HttpSettings::default();
        /// When a flight counts as in trouble.
        #[serde(default)]
        pub failsafe: FailsafeSettings = FailsafeSettings::default();
        /// What goes wrong in the simulators; off by default.
        #[serde(default)]
        pub faults: FaultSettings = FaultSettings::default();
        /// What the flights were planned by, as `dgtr survey` wrote it.
        #[serde(default)]
        pub survey: Option<SurveySettings> = None;
        /// Who flies, and where.
        pub aircraft: Vec<Aircraft>;
    } where Self::fits_together
}

table! {
    /// Manifests (TOML) of the user's own networks.
    pub struct NetworkSettings {
        /// A `pair` network; absent = semi-global matching, which needs none.
        pub pair: Option<PathBuf> = None;
        /// A monocular `depth` network for the depth loss; absent = the pair network's depth × confidence.
        pub depth: Option<PathBuf> = None;
        /// A perceptual `metric` for held-out pictures; absent = PSNR and SSIM only.
        pub metric: Option<PathBuf> = None;
    }
}

impl NetworkSettings {
    /// Takes relative paths as relative to `folder`, where the file that names them lies.
    pub fn anchor(&mut self, folder: &Path) {
        for path in [&mut self.pair, &mut self.depth, &mut self.metric].into_iter().flatten() {
            if path.is_relative() {
                *path = folder.join(&path);
            }
        }
    }
}

record! {
    /// One aircraft and its region.
    pub struct Aircraft {
        /// Short name, `[A-Za-z0-9_-]`, at most 32 characters.
        pub id: String;
        // 0 is MAVLink's broadcast.
        /// MAVLink system id of its autopilot; messages of others are ignored and counted.
        #[serde(default = "one")]
        pub system_id: u8 = 1, in Limits::within(1.0, 255.0);
        /// Link to the autopilot, e.g. `serial:/dev/ttyAMA0:921600`, `udpin:127.0.0.1:14550`.
        pub link: String;
        /// Where the pictures come from: `{ folder = "…" }`, `{ command = ["rpicam-vid", …] }` or, in programs built with the
        /// feature v4l2, `{ v4l2 = "/dev/video0" }`.
        pub camera: CameraSource;
        /// Corners of the region, latitude and longitude. Give this or `region_enu`.
        #[serde(default)]
        pub region_wgs84: Vec<[f64; 2]> = Vec::new(), unit "degrees";
        /// Corners of the region, east and north of the origin.
        #[serde(default)]
        pub region_enu: Vec<[f64; 2]> = Vec::new(), unit "metres";
        /// Device by (part of) its name: processor, or a Vulkan device; absent = the fastest.
        #[serde(default)]
        pub device: Option<String> = None;
        /// Who may offer this aircraft's models, as `dgtr keys` prints it.
        #[serde(default)]
        pub public_key: Option<PublicKey> = None;
    } where Self::named_and_placed
}

fn one() -> u8 {
    1
}

impl Mission {
    /// Reads and checks a mission file. Relative paths in it are taken from the file's own folder.
    ///
    /// # Errors
    /// One line that names the file, the field and the remedy.
    pub fn read(path: &Path) -> Result<Self, MissionError> {
        Ok(Self::read_with_text(path)?.0)
    }

    /// As [`Mission::read`], with the text that was read.
    ///
    /// # Errors
    /// Errors of [`Mission::read`].
    pub fn read_with_text(path: &Path) -> Result<(Self, String), MissionError> {
        let at = |source| MissionError::Unreadable { path: path.into(), source };
        let mut text = String::new();
        let file = disk::regular::open(path).map_err(at)?;
        file.take(MAX_FILE_BYTES + 1).read_to_string(&mut text).map_err(at)?;
        if text.len() as u64 > MAX_FILE_BYTES {
            let bytes = std::fs::metadata(path).map_or(0, |m| m.len()).max(MAX_FILE_BYTES + 1);
            return Err(MissionError::TooLarge { path: path.into(), bytes, limit: MAX_FILE_BYTES });
        }
        let folder = path.parent().unwrap_or(Path::new("."));
        let mission = Self::parse(&text, folder).map_err(|e| e.in_file(path))?;
        Ok((mission, text))
    }

    /// As [`Mission::read`], from text; relative paths are taken from `folder`.
    ///
    /// # Errors
    /// The first line that is not TOML, the first setting that is unknown or cannot be worked with.
    pub fn parse(text: &str, folder: &Path) -> Result<Self, MissionError> {
        let mut mission: Self = crate::settings::parse(text)?;
        mission.anchor_paths(folder);
        let preset = mission.memory.preset.and_then(Preset::values);
        mission.training.seconds = mission.training.seconds.or(preset.map(|p| p.seconds));
        mission.check()?;
        Ok(mission)
    }

    /// The aircraft called `id`; without an id, the only one there is.
    ///
    /// # Errors
    /// None of that name, or several and none chosen.
    pub fn aircraft(&self, id: Option<&str>) -> Result<&Aircraft, MissionError> {
        let known = || self.aircraft.iter().map(|a| a.id.as_str()).collect::<Vec<_>>().join(", ");
        match id {
            Some(id) => self
                .aircraft
                .iter()
                .find(|a| a.id == id)
                .ok_or_else(|| MissionError::NoSuchAircraft { id: id.into(), known: known() }),
            None if self.aircraft.len() == 1 => Ok(&self.aircraft[0]),
            None => Err(MissionError::WhichAircraft { known: known() }),
        }
    }

    /// Aircraft that do not fly any more, since their ground was dealt to the others.
    pub fn lost(&self) -> &[String] {
        self.survey.as_ref().map_or(&[], |survey| &survey.lost)
    }

    /// The region of an aircraft in metres east and north of the mission's origin.
    pub fn region(&self, aircraft: &Aircraft) -> Vec<[f64; 2]> {
        if !aircraft.region_enu.is_empty() {
            return aircraft.region_enu.clone();
        }
        let frame = EnuFrame::new(self.origin);
        let corner = |c: &[f64; 2]| {
            let p = frame.to_enu(Geodetic { lat_deg: c[0], lon_deg: c[1], alt_m: self.origin.alt_m });
            [p.x, p.y]
        };
        aircraft.region_wgs84.iter().map(corner).collect()
    }

    /// Whether offers and receipts are signed, that is, whether the ground and every aircraft have a key.
    ///
    /// # Errors
    /// Only some have one; an endpoint of `[upload]` lies beyond this machine and is not signed and
    /// encrypted without `insecure = true`; a `tls/` endpoint has neither keys nor certificates.
    pub fn check_trust(&self) -> Result<bool, SettingError> {
        let ground = ("ground".to_owned(), self.ground.public_key);
        let aircraft = self.aircraft.iter().enumerate().map(|(i, a)| (format!("aircraft[{i}]"), a.public_key));
        let (with, without): (Vec<_>, Vec<_>) = aircraft.chain([ground]).partition(|k| k.1.is_some());
        if let (Some((known, _)), Some((unknown, key))) = (with.first(), without.first()) {
            let wanted = format!("given as {known} has one, too; `dgtr keys` makes it");
            return Err(SettingError::new("public_key", key, wanted).at(unknown));
        }
        match self.upload.exposed() {
            Some((field, endpoint)) if !self.upload.insecure && with.is_empty() => {
                let wanted = "on this machine while nothing is signed; make keys with `dgtr keys`, or say insecure = true \
                              in [upload]";
                Err(SettingError::new(field, endpoint, wanted).at("upload"))
            }
            Some((field, endpoint)) if !self.upload.insecure && !self.upload.has_tls() => {
                let wanted = "encrypted, as it leaves this machine: write tls/HOST:PORT, for which the keys are enough, or say \
                              insecure = true in [upload]";
                Err(SettingError::new(field, endpoint, wanted).at("upload"))
            }
            _ if self.upload.has_tls() && self.upload.tls.is_none() && with.is_empty() => {
                let wanted = "given, as tls/ endpoints are encrypted by the keys: `dgtr keys` makes them";
                Err(SettingError::new("public_key", &self.ground.public_key, wanted).at("ground"))
            }
            _ => Ok(!with.is_empty()),
        }
    }

    fn anchor_paths(&mut self, folder: &Path) {
        let anchor = |p: &mut PathBuf| {
            if p.is_relative() {
                *p = folder.join(&p);
            }
        };
        self.network.anchor(folder);
        if let Some(p) = &mut self.upload.folder {
            anchor(p);
        }
        anchor(&mut self.upload.keys);
        if let Some(p) = &mut self.http.token_file {
            anchor(p);
        }
        if let Some(p) = &mut self.link.signing_key {
            anchor(p);
        }
        if let Some(tls) = &mut self.upload.tls {
            for p in [&mut tls.authority, &mut tls.certificate, &mut tls.key] {
                anchor(p);
            }
        }
        if let Some(terrain) = self.survey.as_mut().and_then(|survey| survey.terrain.as_mut()) {
            anchor(terrain);
        }
        for aircraft in &mut self.aircraft {
            if let CameraSource::Folder(p) = &mut aircraft.camera {
                anchor(p);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = r#"
name = "park"
origin = { lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }
camera = { width = 640, height = 480, fx = 385.0, fy = 385.0, cx = 320.0, cy = 240.0 }
[[aircraft]]
id = "a1"
link = "udpin:127.0.0.1:14550"
camera = { folder = "a1" }
region_enu = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]
"#;

    fn refused(from: &str, to: &str) -> String {
        match Mission::parse(&GOOD.replace(from, to), Path::new("/m")) {
            Err(e) => e.to_string(),
            Ok(_) => panic!("{to} was accepted"),
        }
    }

    #[test]
    fn a_small_mission_is_read_and_its_paths_are_anchored() {
        let m = Mission::parse(GOOD, Path::new("/m")).expect("parses");
        assert_eq!(m.aircraft[0].camera, CameraSource::Folder("/m/a1".into()));
        assert_eq!(m.region(m.aircraft(None).expect("one")).len(), 3);
    }

    #[test]
    fn wrong_missions_are_refused_with_field_and_remedy() {
        assert!(refused("name = \"park\"", "name = \"a/b\"").contains("name = \"a/b\""));
        assert!(refused("name = \"park\"", "name = 3").starts_with("line 2"));
        assert!(refused("fx = 385.0", "fx = nan").contains("camera.fx = nan"));
        assert!(refused("link =", "lnik =").contains("line 7: unknown setting `lnik`; did you mean `link`?"));
        assert!(refused("[10.0, 10.0]", "[20.0, 0.0]").contains("area"));
        assert!(refused("lat_deg = 28.0", "lat_deg = 280.0").contains("origin"));
        assert!(refused("id = \"a1\"", "id = \"a1\"\nsystem_id = 0").contains("system_id"));
    }

    #[test]
    fn aircraft_whose_names_differ_in_capitals_alone_would_share_a_folder_of_a_stick_and_are_refused() {
        let (head, aircraft) = GOOD.split_once("[[aircraft]]").expect("an aircraft");
        for (id, wanted) in [("A1", false), ("a1", false), ("b1", true)] {
            let other = aircraft.replace("\"a1\"", &format!("\"{id}\""));
            let both = format!("{head}[[aircraft]]{aircraft}[[aircraft]]{other}");
            let read = Mission::parse(&both, Path::new("/m")).map_err(|e| e.to_string());
            let told = read.as_ref().err().is_some_and(|e| e.contains("aircraft[1].id") && e.contains("capitals"));
            assert_eq!((read.is_ok(), told), (wanted, !wanted), "{id}: {read:?}");
        }
    }

    #[test]
    fn whoever_does_not_fly_any_more_is_an_aircraft_of_the_mission() {
        let survey =
            SurveySettings { endurance_min: vec![25.0], take_off: vec![[28.0, -82.0]], ..SurveySettings::usual(2.0) };
        for (id, wanted) in [("a1", true), ("a2", false)] {
            let text = SurveySettings { lost: vec![id.into()], ..survey.clone() }.text();
            let read = Mission::parse(&format!("{GOOD}\n{text}"), Path::new("/m")).map_err(|e| e.to_string());
            let told = read.as_ref().err().is_some_and(|e| e.contains("survey.lost") && e.contains("\"a2\""));
            assert_eq!((read.is_ok(), told), (wanted, !wanted), "{id}: {read:?}");
        }
    }

    /// `[link]` was read but never checked: with NaN, and with 0, the link counted as lost for ever.
    #[test]
    fn every_table_is_checked_and_the_setting_is_named_by_its_path() {
        for (table, path) in [
            ("link = { heartbeat_timeout_s = nan }", "link.heartbeat_timeout_s = nan: must be 0.1 to 3600"),
            ("link = { heartbeat_timeout_s = 0.0 }", "link.heartbeat_timeout_s"),
            ("mount = { max_tilt_deg = 0.0 }", "mount.max_tilt_deg"),
            ("keyframes = { max = 1 }", "keyframes.max"),
            ("memory = { image_scale = 1.5 }", "memory.image_scale"),
            ("upload = { poll_s = 0.0 }", "upload.poll_s"),
            ("ground = { scale = nan }", "ground.scale"),
            ("init = { stride = 0 }", "init.stride"),
            ("refine = { max_pairs = 0 }", "refine.max_pairs"),
            ("training = { rates = { opacity = -1.0 } }", "training.rates.opacity"),
            ("faults = { nan_pct = 120.0 }", "faults.nan_pct"),
        ] {
            let told = refused("name = \"park\"", &format!("name = \"park\"\n{table}"));
            assert!(told.starts_with(path), "{told}");
        }
        assert!(refused("fx = 385.0", "fx = 0.0").starts_with("camera.fx"));
        assert!(
            refused("link = \"udpin:127.0.0.1:14550\"", "link = \"\"\nsystem_id = 0")
                .starts_with("aircraft[0].system_id")
        );
    }

    #[test]
    fn a_video_device_is_a_camera_if_its_path_is_absolute() {
        let text = GOOD.replace("folder = \"a1\"", "v4l2 = \"/dev/video2\"");
        let m = Mission::parse(&text, Path::new("/m")).expect("parses");
        assert_eq!(m.aircraft[0].camera, CameraSource::V4l2("/dev/video2".into()));
        assert!(refused("folder = \"a1\"", "v4l2 = \"video2\"").contains("/dev/video0"));
    }

    #[test]
    fn a_preset_gives_seconds_unless_the_mission_does() {
        let seconds = |more: &str| {
            let table = format!("name = \"park\"\nmemory = {{ preset = \"tiny\" }}\n{more}");
            let text = GOOD.replace("name = \"park\"", &table);
            Mission::parse(&text, Path::new("/m")).expect("parses").training.seconds
        };
        assert_eq!(seconds(""), Preset::Tiny.values().map(|v| v.seconds));
        assert_eq!(seconds("training = { seconds = 7.0 }"), Some(7.0));
    }

    #[test]
    fn an_endpoint_beyond_this_machine_needs_keys_or_the_word_insecure() {
        let key = |n: u8| format!("public_key = \"{}\"", PublicKey([n; 32]));
        let trust = |upload: &str, ground: &str, aircraft: &str| {
            let tables = format!("name = \"park\"\nupload = {{ {upload} }}\nground = {{ {ground} }}");
            let id = format!("id = \"a1\"\n{aircraft}");
            let text = GOOD.replace("name = \"park\"", &tables).replace("id = \"a1\"", &id);
            let mission = Mission::parse(&text, Path::new("/m")).expect("parses");
            mission.check_trust().map_err(|e| e.to_string())
        };
        let outside = "listen = [\"tcp/0.0.0.0:7447\"]";
        assert!(
            trust(outside, "", "")
                .is_err_and(|e| e.contains("upload.listen = \"tcp/0.0.0.0") && e.contains("dgtr keys"))
        );
        assert_eq!(trust(&format!("{outside}, insecure = true"), "", ""), Ok(false));
        assert_eq!(trust("listen = [\"tcp/127.0.0.1:7447\"]", "", ""), Ok(false));
        assert!(trust(outside, &key(1), &key(2)).is_err_and(|e| e.contains("tls/HOST:PORT")));
        assert_eq!(trust(&format!("{outside}, insecure = true"), &key(1), &key(2)), Ok(true));
        assert_eq!(trust("listen = [\"tls/0.0.0.0:7447\"]", &key(1), &key(2)), Ok(true));
        assert!(trust("listen = [\"tls/127.0.0.1:7447\"]", "", "").is_err_and(|e| e.contains("dgtr keys")));
        // Half of the keys protect nobody, even here.
        assert!(trust("", &key(1), "").is_err_and(|e| e.starts_with("aircraft[0].public_key = absent")));
        assert!(trust("", "", &key(2)).is_err_and(|e| e.starts_with("ground.public_key = absent")));
    }

    #[test]
    fn a_key_of_two_owners_or_of_an_aircraft_called_ground_is_refused() {
        let key = |n: u8| format!("public_key = \"{}\"", PublicKey([n; 32]));
        let twice = format!("ground = {{ {} }}\n[[aircraft]]\n{}", key(3), key(3));
        assert!(refused("[[aircraft]]", &twice).contains("nobody else's"));
        for id in ["ground", "Ground"] {
            assert!(refused("id = \"a1\"", &format!("id = \"{id}\"\n{}", key(4))).contains("ground.key"));
        }
        assert!(refused("id = \"a1\"", "id = \"a1\"\npublic_key = \"abc\"").contains("64 hexadecimal digits"));
    }

    #[test]
    fn a_missing_mission_file_is_named() {
        let e = Mission::read(Path::new("/nonexistent/m.toml")).expect_err("missing");
        assert!(e.to_string().contains("/nonexistent/m.toml"));
    }
}
