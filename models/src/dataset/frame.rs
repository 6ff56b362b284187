//! One picture of a data set.

use std::path::PathBuf;

use config::lens::Distortion;

use crate::camera::{PosePrior, View};
use crate::formats::telemetry::Telemetry;
use crate::picture::Orientation;

/// One picture of the set.
#[derive(Clone, Debug)]
pub struct DatasetFrame {
    /// File name (with its folder only where names would repeat).
    pub name: String,
    /// Where the picture lies.
    pub path: PathBuf,
    /// Lens (undistorted, full size) and reconstructed pose.
    pub view: View,
    /// What is taken out of the picture on loading.
    pub distortion: Distortion,
    /// How the stored picture is turned on loading.
    pub orientation: Orientation,
    /// Its mask, where there is one: a picture of the stored one's shape, black where nothing is to be learnt.
    pub mask: Option<PathBuf>,
    /// Pose from GPS and gimbal angles, where recorded.
    pub prior: Option<PosePrior>,
    /// The row of `gps.csv` that it comes from.
    pub telemetry: Option<Telemetry>,
}
