//! The mission file: one TOML file shared by every aircraft and the ground. It names the origin, who flies where,
//! the camera and its mount, and the budgets; each area's own settings live in its own module and appear here as
//! one table.
//!
//! Everything is checked once, on reading: what [`Mission::read`] returns needs no further validation.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::faults::FaultSettings;
use crate::geodesy::{EnuFrame, Geodetic};
use crate::ground::GroundSettings;
use crate::init::InitSettings;
use crate::link::LinkSettings;
use crate::preset::Preset;
use crate::refine::RefineSettings;
use crate::training::TrainSettings;
use crate::upload::UploadSettings;

mod error;
mod memory;
mod validate;

pub use error::MissionError;
pub use memory::MemorySettings;

/// A mission file larger than this is refused before it is parsed.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// What all aircraft and the ground share.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Mission {
    /// Short name, part of every key on the wire: `[A-Za-z0-9_-]`, at most 32 characters.
    pub name: String,
    /// Seed of everything random: simulators, training, faults.
    #[serde(default)]
    pub seed: u64,
    /// Origin of the local East-North-Up frame.
    pub origin: Geodetic,
    /// The lens, as calibrated.
    pub camera: CameraSettings,
    /// How the camera sits on the aircraft.
    #[serde(default)]
    pub mount: MountSettings,
    /// The link to the autopilot, signing, and how pictures are matched.
    #[serde(default)]
    pub link: LinkSettings,
    /// When a picture becomes a key frame.
    #[serde(default)]
    pub keyframes: KeyframeSettings,
    /// The budgets everything is planned from.
    #[serde(default)]
    pub memory: MemorySettings,
    /// Manifests of the user's own networks.
    #[serde(default)]
    pub network: NetworkSettings,
    /// How models reach the ground.
    #[serde(default)]
    pub upload: UploadSettings,
    /// How the ground merges and distils them.
    #[serde(default)]
    pub ground: GroundSettings,
    /// How pictures become the first Gaussians.
    #[serde(default)]
    pub init: InitSettings,
    /// How telemetry's poses are refined.
    #[serde(default)]
    pub refine: RefineSettings,
    /// The training recipe.
    #[serde(default)]
    pub training: TrainSettings,
    /// What goes wrong in the simulators; off by default.
    #[serde(default)]
    pub faults: FaultSettings,
    /// Who flies, and where.
    pub aircraft: Vec<Aircraft>,
}

/// Calibration of the camera, pixels of the full picture; centre of the top-left pixel at (0.5, 0.5).
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CameraSettings {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Focal length along x.
    pub fx: f32,
    /// Focal length along y.
    pub fy: f32,
    /// Principal point x.
    pub cx: f32,
    /// Principal point y.
    pub cy: f32,
    /// Brown–Conrady k1, k2, p1, p2 (OpenCV's order); zeros for pictures that are already undistorted.
    #[serde(default)]
    pub distortion: [f32; 4],
    /// From the trigger's time stamp (of a video device, the driver's) to the middle of the exposure, milliseconds; most
    /// drivers stamp the end of a picture, so that it is negative there.
    #[serde(default)]
    pub exposure_delay_ms: f32,
}

/// Where the camera's attitude comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum MountAttitude {
    /// The autopilot reports it (GIMBAL_DEVICE_ATTITUDE_STATUS).
    #[default]
    Gimbal,
    /// Bolted to the airframe at `rotation_deg`.
    Fixed,
}

/// How the camera sits on the aircraft.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct MountSettings {
    /// Where the camera's attitude comes from.
    pub attitude: MountAttitude,
    /// Roll, pitch, yaw of the optical axis against the airframe for a fixed mount, degrees; pitch −90 looks down. For a
    /// gimbal the pitch it is set to, only for `max_tilt_deg`; zeros = not known.
    pub rotation_deg: [f32; 3],
    /// Camera centre in the body, metres forward, left, up of the position the autopilot reports.
    pub lever_arm_m: [f32; 3],
    /// Exposures are left out when the optical axis is further than this from where the mount points it on a level airframe,
    /// degrees (ArduPilot's "trigger immediately" fires in turns); 180 = never.
    pub max_tilt_deg: f32,
}

impl Default for MountSettings {
    fn default() -> Self {
        Self {
            attitude: MountAttitude::Gimbal,
            rotation_deg: [0.0; 3],
            lever_arm_m: [0.0; 3],
            // Beyond what an autopilot flies on purpose: ArduPlane's ROLL_LIMIT_DEG is 45, ArduCopter's ANGLE_MAX 30.
            max_tilt_deg: 50.0,
        }
    }
}

/// The key-frame rule of the paper (after NeuralRecon): moved more than `t_min_m` **or** turned more than `r_max_deg`.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct KeyframeSettings {
    /// Least translation from the last key frame, metres.
    pub t_min_m: f32,
    /// Or least rotation from it, degrees (15, NeuralRecon).
    pub r_max_deg: f32,
    /// Most key frames of one aircraft: the size of the rings and of the resident views.
    pub max: u32,
    /// Leave out pictures from where an earlier key frame already stood.
    pub skip_covered: bool,
}

impl Default for KeyframeSettings {
    fn default() -> Self {
        Self { t_min_m: 5.0, r_max_deg: 15.0, max: 128, skip_covered: true }
    }
}

/// Manifests (TOML) of the user's own networks.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkSettings {
    /// A `pair` network; absent = the embedded plane sweep.
    pub pair: Option<PathBuf>,
    /// A monocular `depth` network for the depth loss; absent = the pair network's depth × confidence.
    pub depth: Option<PathBuf>,
    /// A perceptual `metric` for held-out pictures; absent = PSNR and SSIM only.
    pub metric: Option<PathBuf>,
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

/// Where an aircraft's pictures come from.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraSource {
    /// A folder that another program writes JPEG or PNG files into.
    Folder(PathBuf),
    /// A program that writes an MJPEG stream to its standard output, with its arguments.
    Command(Vec<String>),
    /// A video device of the kernel, e.g. `/dev/video0`; only in programs built with the feature `v4l2`.
    V4l2(PathBuf),
}

/// One aircraft and its region.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Aircraft {
    /// Short name, `[A-Za-z0-9_-]`, at most 32 characters.
    pub id: String,
    /// MAVLink system id of its autopilot; messages of others are ignored and counted.
    #[serde(default = "one")]
    pub system_id: u8,
    /// Link to the autopilot, e.g. `serial:/dev/ttyAMA0:921600`, `udpin:127.0.0.1:14550`.
    pub link: String,
    /// Where the pictures come from.
    pub camera: CameraSource,
    /// Corners of the region, degrees latitude and longitude. Give this or `region_enu`.
    #[serde(default)]
    pub region_wgs84: Vec<[f64; 2]>,
    /// Corners of the region, metres east and north of the origin.
    #[serde(default)]
    pub region_enu: Vec<[f64; 2]>,
    /// Vulkan device by (part of) its name; absent = the best one.
    #[serde(default)]
    pub device: Option<String>,
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
        let at = |source| MissionError::Unreadable { path: path.into(), source };
        let size = std::fs::metadata(path).map_err(at)?.len();
        if size > MAX_FILE_BYTES {
            return Err(MissionError::TooLarge { path: path.into(), bytes: size, limit: MAX_FILE_BYTES });
        }
        let text = std::fs::read_to_string(path).map_err(at)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        Self::parse(&text, folder).map_err(|e| e.in_file(path))
    }

    /// As [`Mission::read`], from text; relative paths are taken from `folder`.
    pub fn parse(text: &str, folder: &Path) -> Result<Self, MissionError> {
        let mut mission: Self = toml::from_str(text).map_err(|e| MissionError::syntax(text, &e))?;
        mission.anchor_paths(folder);
        let preset = mission.memory.preset.map(Preset::values);
        mission.training.seconds = mission.training.seconds.or(preset.map(|p| p.seconds));
        validate::check(&mission)?;
        Ok(mission)
    }

    /// The aircraft called `id`; without an id, the only one there is.
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
        if let Some(p) = &mut self.link.signing_key {
            anchor(p);
        }
        if let Some(tls) = &mut self.upload.tls {
            for p in [&mut tls.authority, &mut tls.certificate, &mut tls.key] {
                anchor(p);
            }
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
        assert!(refused("name = \"park\"", "name = \"a/b\"").contains("name: 'a/b'"));
        assert!(refused("name = \"park\"", "name = 3").starts_with("line 2"));
        assert!(refused("fx = 385.0", "fx = nan").contains("fx and fy"));
        assert!(refused("link =", "lnik =").contains("lnik"));
        assert!(refused("[10.0, 10.0]", "[20.0, 0.0]").contains("area"));
        assert!(refused("lat_deg = 28.0", "lat_deg = 280.0").contains("origin"));
        assert!(refused("id = \"a1\"", "id = \"a1\"\nsystem_id = 0").contains("system_id"));
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
            let table = format!("name = \"park\"\nmemory = {{ preset = \"ci\" }}\n{more}");
            let text = GOOD.replace("name = \"park\"", &table);
            Mission::parse(&text, Path::new("/m")).expect("parses").training.seconds
        };
        assert_eq!(seconds(""), Some(Preset::Ci.values().seconds));
        assert_eq!(seconds("training = { seconds = 7.0 }"), Some(7.0));
    }

    #[test]
    fn a_missing_mission_file_is_named() {
        let e = Mission::read(Path::new("/nonexistent/m.toml")).expect_err("missing");
        assert!(e.to_string().contains("/nonexistent/m.toml"));
    }
}
