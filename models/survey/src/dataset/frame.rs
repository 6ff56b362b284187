//! One picture of a data set.

use std::path::PathBuf;

use geometry::lens::{Distortion, Lens};

use models::camera::{PosePrior, View};
use models::formats::telemetry::Telemetry;
use models::picture::Orientation;
use models::picture::values::ValueRange;

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
    /// Which of its 16-bit values become black and white; `None` for pictures of eight bits.
    pub values: Option<ValueRange>,
    /// Pose from GPS and gimbal angles, where recorded.
    pub prior: Option<PosePrior>,
    /// The row of `gps.csv` that it comes from.
    pub telemetry: Option<Telemetry>,
}

impl DatasetFrame {
    /// Where a pixel of the picture as it is stored lies in the picture as it is loaded at `size`; `None` outside of what a pinhole
    /// shows.
    pub fn loaded_pixel(&self, stored: [f64; 2], size: (u32, u32)) -> Option<[f32; 2]> {
        let full = &self.view.intrinsics;
        let [width, height] = [f64::from(full.width), f64::from(full.height)];
        let (w, h) = if self.orientation.swaps() { (height, width) } else { (width, height) };
        let [u, v] = self.orientation.inverse().stored_place([stored[0] / w, stored[1] / h]);
        let lens = Lens {
            focal: [full.fx.into(), full.fy.into()],
            principal: [full.cx.into(), full.cy.into()],
            distortion: self.distortion,
        };
        let [x, y] = lens.unproject([u * width, v * height])?;
        let at = [x * lens.focal[0] + lens.principal[0], y * lens.focal[1] + lens.principal[1]];
        let inside = (0.0..=width).contains(&at[0]) && (0.0..=height).contains(&at[1]);
        inside.then(|| [(at[0] / width * f64::from(size.0)) as f32, (at[1] / height * f64::from(size.1)) as f32])
    }
}
