//! The list of key frames: a nerfstudio `transforms.json` with what only this project needs in a `dgtr` object per frame.

use std::path::Path;

use config::mission::CameraSettings;
use geometry::geodesy::Geodetic;
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::formats::{FormatError, read_bounded};
use serde::{Deserialize, Serialize};

/// The list's name, as nerfstudio reads it.
pub(super) const FILE: &str = "transforms.json";
/// 4,096 key frames (the most a mission allows) at 2 KiB each.
const SIZE_LIMIT: u64 = 8 << 20;

#[derive(Serialize, Deserialize)]
pub(super) struct List {
    camera_model: String,
    fl_x: f32,
    fl_y: f32,
    cx: f32,
    cy: f32,
    k1: f32,
    k2: f32,
    p1: f32,
    p2: f32,
    pub(super) w: u32,
    pub(super) h: u32,
    enu_origin_wgs84: Origin,
    pub(super) frames: Vec<Entry>,
}

impl List {
    /// An empty one of pictures as `camera` gives them.
    pub(super) fn new(camera: &CameraSettings, origin: Geodetic) -> Self {
        let [k1, k2, p1, p2] = camera.distortion;
        Self {
            camera_model: if camera.distortion == [0.0; 4] { "PINHOLE" } else { "OPENCV" }.into(),
            fl_x: camera.fx,
            fl_y: camera.fy,
            cx: camera.cx,
            cy: camera.cy,
            k1,
            k2,
            p1,
            p2,
            w: camera.width,
            h: camera.height,
            enu_origin_wgs84: Origin { lat: origin.lat_deg, lon: origin.lon_deg, alt: origin.alt_m },
            frames: Vec::new(),
        }
    }

    /// The lens of every picture.
    fn intrinsics(&self) -> Intrinsics {
        Intrinsics { width: self.w, height: self.h, fx: self.fl_x, fy: self.fl_y, cx: self.cx, cy: self.cy }
    }

    /// Whether a picture can lie where it says, and be trained from: what it names may be removed later, and is ours only there.
    fn is_usable(&self, frame: &Entry) -> bool {
        let named = frame.file_path.strip_prefix("images/").is_some_and(|n| !n.is_empty() && !n.contains(['/', '\0']));
        named && View { intrinsics: self.intrinsics(), pose: frame.dgtr.pose }.is_usable()
    }
}

#[derive(Serialize, Deserialize)]
struct Origin {
    lat: f64,
    lon: f64,
    alt: f64,
}

#[derive(Serialize, Deserialize)]
pub(super) struct Entry {
    pub(super) file_path: String,
    pub(super) transform_matrix: [[f64; 4]; 4],
    pub(super) dgtr: Extra,
}

/// What nerfstudio's format has no field for.
#[derive(Clone, Copy, Serialize, Deserialize)]
pub(super) struct Extra {
    pub(super) time_ns: u64,
    pub(super) pose: Pose,
    /// Null where nothing is known: JSON has no infinity.
    pub(super) position_sigma_m: [Option<f32>; 3],
    pub(super) rotation_sigma_rad: [Option<f32>; 3],
}

impl Extra {
    pub(super) fn new(frame: &PosedImage) -> Self {
        let known = |sigma: [f32; 3]| sigma.map(|s| s.is_finite().then_some(s));
        Self {
            time_ns: frame.time_ns,
            pose: frame.view.pose,
            position_sigma_m: known(frame.sigma.position_m),
            rotation_sigma_rad: known(frame.sigma.rotation_rad),
        }
    }

    pub(super) fn sigma(&self) -> PoseSigma {
        let or_infinite = |sigma: [Option<f32>; 3]| sigma.map(|s| s.unwrap_or(f32::INFINITY));
        PoseSigma { position_m: or_infinite(self.position_sigma_m), rotation_rad: or_infinite(self.rotation_sigma_rad) }
    }
}

pub(super) fn read_list(path: &Path) -> Result<List, FormatError> {
    let bytes = read_bounded(path, SIZE_LIMIT)?;
    let invalid = |what: String| FormatError::Invalid { path: path.into(), what };
    let list: List = serde_json::from_slice(&bytes).map_err(|e| invalid(format!("not a list of key frames: {e}")))?;
    match list.frames.iter().find(|f| !list.is_usable(f)) {
        Some(f) => Err(invalid(format!("key frame {:?} has no place in the folder, or no pose", f.file_path))),
        None => Ok(list),
    }
}

/// Key frames are known by the name of their file.
pub(super) fn name(file_path: &str) -> String {
    file_path.rsplit('/').next().unwrap_or(file_path).to_owned()
}
