//! The members of QGroundControl's `.plan` that are read.

use serde::Deserialize;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct File {
    pub file_type: String,
    pub mission: Mission,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Mission {
    pub hover_speed: Option<f64>,
    pub cruise_speed: Option<f64>,
    pub planned_home_position: [f64; 3],
    pub items: Vec<Item>,
}

#[derive(Deserialize)]
pub struct Item {
    #[serde(rename = "type")]
    pub kind: String,
    pub command: Option<u32>,
    pub frame: Option<u32>,
    #[serde(default)]
    pub params: [Option<f64>; 7],
    #[serde(rename = "complexItemType")]
    pub complex: Option<String>,
    #[serde(rename = "TransectStyleComplexItem")]
    pub transects: Option<Transects>,
    /// Of a survey whose transects hold no items: height above home.
    #[serde(rename = "Altitude")]
    pub altitude: Option<f64>,
}

/// What QGroundControl's surveys and corridor scans have in common.
#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
pub struct Transects {
    /// What is sent to the vehicle.
    pub items: Option<Vec<Item>>,
    pub hover_and_capture: Option<bool>,
    pub visual_transect_points: Option<Vec<[f64; 2]>>,
    pub camera_calc: Option<CameraCalc>,
}

/// `QGroundControlQmlGlobal::AltitudeModeRelative`.
const ABOVE_HOME: u32 = 1;

#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
pub struct CameraCalc {
    pub adjusted_footprint_frontal: Option<f64>,
    pub distance_to_surface: Option<f64>,
    /// What the distance is measured from: false, or another number than [`ABOVE_HOME`], is not the home's height.
    pub distance_to_surface_relative: Option<bool>,
    pub distance_mode: Option<u32>,
}

impl Mission {
    /// Items with those that surveys hold.
    pub fn count(&self) -> usize {
        let of = |t: &Transects| {
            t.items.as_ref().map_or(0, Vec::len) + t.visual_transect_points.as_ref().map_or(0, Vec::len)
        };
        self.items.iter().map(|item| 1 + item.transects.as_ref().map_or(0, of)).sum()
    }
}

impl CameraCalc {
    /// Whether its distance counts from the height of home.
    pub fn is_above_home(&self) -> bool {
        self.distance_to_surface_relative != Some(false) && self.distance_mode.is_none_or(|mode| mode == ABOVE_HOME)
    }
}
