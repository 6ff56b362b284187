//! How well the poses and the lens of a card are known, in files that people read: `poses.csv` and `lens.json` beside the model.

use std::collections::HashMap;
use std::fmt::Write;
use std::path::Path;

use disk::Disk;
use glam::DVec3;
use models::refine::{LensPrecision, PosePrecision, SharedEstimate};
use survey::dataset::{Dataset, DatasetFrame, Settled};
use survey::settling::Settlement;

use crate::error::JobError;

/// Poses of the pictures that are part of the scene, with their standard deviations.
const POSES: &str = "poses.csv";
/// The lens that they share, with its standard deviations and correlations.
const LENS: &str = "lens.json";

/// What a settled card knows of its poses and its lens.
pub(super) struct Known {
    poses: HashMap<String, PosePrecision>,
    lens: Option<LensPrecision>,
    estimate: SharedEstimate,
    in_metres: bool,
    /// Stated positions had a say, so that what is left of them is worth telling.
    has_positions: bool,
}

/// Where a picture says that it was taken.
#[derive(Clone, Copy)]
struct Stated {
    center: DVec3,
    sigma_m: [f32; 3],
}

impl Known {
    pub(super) fn of(found: &Settlement, in_metres: bool, has_positions: bool) -> Self {
        // What two halves of the points differ by is no standard deviation that a map could be defended with.
        let poses =
            found.precision.iter().filter(|(_, p)| p.by_equations).map(|(name, p)| (name.clone(), *p)).collect();
        let (lens, estimate) = (found.lens.clone(), found.solved.shared.clone());
        Self { poses, lens, estimate, in_metres, has_positions }
    }

    fn unit(&self) -> &'static str {
        if self.in_metres { "m" } else { "units of the scene" }
    }

    /// The median standard deviations, for run.json.
    pub(super) fn usual(&self) -> serde_json::Value {
        let of = |value: &dyn Fn(&PosePrecision) -> Option<f64>| {
            let mut all: Vec<f64> = self.poses.values().filter_map(value).filter(|s| s.is_finite()).collect();
            all.sort_by(f64::total_cmp);
            all.get(all.len() / 2).copied()
        };
        let [east, north, up] = [0, 1, 2].map(|axis| of(&|p| Some(p.position[axis])));
        let largest = of(&|p| Some(p.rotation_deg?.into_iter().fold(0.0, f64::max)));
        serde_json::json!({
            "unit": self.unit(), "median_east": east, "median_north": north, "median_up": up, "median_rotation_deg": largest
        })
    }

    /// Writes both files.
    pub(super) fn write(&self, set: &Dataset, settled: &HashMap<String, Settled>, out: &Path) -> Result<(), JobError> {
        let mut text = String::from(if self.in_metres {
            "name,east_m,north_m,up_m,sigma_east_m,sigma_north_m,sigma_up_m,sigma_right_deg,sigma_down_deg,sigma_forward_deg,\
             stated_off_east_m,stated_off_north_m,stated_off_up_m,off_in_stated_sigmas\n"
        } else {
            "name,x,y,z,sigma_x,sigma_y,sigma_z,sigma_right_deg,sigma_down_deg,sigma_forward_deg,\
             stated_off_x,stated_off_y,stated_off_z,off_in_stated_sigmas\n"
        });
        let mut frames: Vec<&DatasetFrame> = set.frames.iter().filter(|f| settled.contains_key(&f.name)).collect();
        frames.sort_by(|a, b| a.name.cmp(&b.name));
        for frame in frames {
            let told = frame.prior.filter(|p| self.has_positions && p.pose.center.is_finite());
            let stated = told.map(|p| Stated { center: p.pose.center, sigma_m: p.sigma.position_m });
            self.row(&frame.name, settled[&frame.name].view.pose.center, stated, &mut text);
        }
        let to = out.join(POSES);
        let disk = Disk::default();
        disk.replace(&to, |file| file.write_all(text.as_bytes())).map_err(|e| JobError::io(&to)(e.into()))?;
        let lens = serde_json::json!({ "estimate": self.estimate, "precision": self.lens });
        let to = out.join(LENS);
        let lens = serde_json::to_vec_pretty(&lens)?;
        disk.replace(&to, |file| file.write_all(&lens)).map_err(|e| JobError::io(&to)(e.into()))
    }

    /// One picture: where it was taken, how well that is known, and how far from there it says that it was taken.
    fn row(&self, name: &str, center: DVec3, stated: Option<Stated>, text: &mut String) {
        let known = self.poses.get(name);
        let number = |value: Option<f64>, digits: usize| match value.filter(|v| v.is_finite()) {
            Some(value) => format!("{value:.digits$}"),
            None => String::new(),
        };
        let mut cells = vec![disk::table::field(name).into_owned()];
        cells.extend(center.to_array().map(|c| number(Some(c), 4)));
        cells.extend([0, 1, 2].map(|axis| number(known.map(|k| k.position[axis]), 4)));
        cells.extend([0, 1, 2].map(|axis| number(known.and_then(|k| Some(k.rotation_deg?[axis])), 4)));
        match stated.filter(|s| s.sigma_m.iter().all(|s| s.is_finite())) {
            Some(stated) => {
                let off = (stated.center - center).to_array();
                let sigmas = [0, 1, 2].map(|axis| off[axis].abs() / f64::from(stated.sigma_m[axis]));
                cells.extend(off.map(|o| number(Some(o), 3)));
                cells.push(number(Some(sigmas.into_iter().fold(0.0, f64::max)), 2));
            }
            None => cells.extend([const { String::new() }; 4]),
        }
        let _ = writeln!(text, "{}", cells.join(","));
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    fn precision(east: f64) -> PosePrecision {
        PosePrecision { position: [east, 0.2, 0.3], by_equations: true, rotation_deg: None }
    }

    #[test]
    fn what_run_json_says_is_the_median_and_has_a_unit() {
        let poses = [1.0, 9.0, 2.0].iter().enumerate().map(|(i, s)| (i.to_string(), precision(*s))).collect();
        let mut known =
            Known { poses, lens: None, estimate: SharedEstimate::default(), in_metres: true, has_positions: true };
        let said = known.usual();
        assert_eq!((&said["median_east"], &said["unit"]), (&2.0.into(), &"m".into()));
        assert!(said["median_rotation_deg"].is_null());
        (known.in_metres, known.poses) = (false, HashMap::new());
        assert_eq!(known.usual()["unit"], "units of the scene");
        assert!(known.usual()["median_up"].is_null());
    }

    #[test]
    fn a_row_says_how_far_off_stated_positions_are_in_their_own_sigmas() {
        let poses = [("=1,2.jpg".to_owned(), precision(0.1))].into();
        let known =
            Known { poses, lens: None, estimate: SharedEstimate::default(), in_metres: true, has_positions: true };
        let stated = Stated { center: DVec3::new(10.0, 20.0, 50.0), sigma_m: [1.0, 1.0, 2.0] };
        let mut row = String::new();
        known.row("=1,2.jpg", DVec3::new(10.0, 20.0, 53.0), Some(stated), &mut row);
        // Three metres down, where two are stated.
        let wanted = "\"'=1,2.jpg\",10.0000,20.0000,53.0000,0.1000,0.2000,0.3000,,,,0.000,0.000,-3.000,1.50";
        assert_eq!(row.trim_end(), wanted);
        row.clear();
        known.row("b.jpg", DVec3::ZERO, None, &mut row);
        assert_eq!(row.trim_end(), "b.jpg,0.0000,0.0000,0.0000,,,,,,,,,,");
    }
}
