//! Flights of poses for the tests of this module.

use config::coverage::CoverageSettings;
use glam::{DVec2, DVec3};

use super::{CoverageMap, CoverageRegion};
use models::camera::{Intrinsics, Pose, View};
use models::formats::telemetry::dji_rotation;

/// 48 m by 36 m of ground from 40 m.
pub(super) const LENS: Intrinsics = Intrinsics { width: 80, height: 60, fx: 66.0, fy: 66.0, cx: 40.0, cy: 30.0 };

pub(super) fn view(center: DVec3, yaw_deg: f64, pitch_deg: f64) -> View {
    View { intrinsics: LENS, pose: Pose { rotation: dji_rotation(yaw_deg, pitch_deg, 0.0), center } }
}

/// A rectangle with its south-west corner at `at`.
pub(super) fn rectangle(at: DVec2, size: DVec2) -> CoverageRegion {
    CoverageRegion::new(vec![at, at + size * DVec2::X, at + size, at + size * DVec2::Y]).expect("an area")
}

pub(super) fn map(region: &CoverageRegion) -> CoverageMap {
    CoverageMap::new(region, 0.0, CoverageSettings::default()).expect("a map")
}

/// A survey from 40 m over a rectangle of this size at `at`, lines 19 m and pictures 9 m apart, with a margin of 20 m.
pub(super) fn survey(at: DVec2, size: DVec2, pitch_deg: f64) -> Vec<View> {
    let count = ((size + 40.0) / DVec2::new(19.0, 9.0)).ceil();
    let mut views = Vec::new();
    for line in 0..=count.x as usize {
        for shot in 0..=count.y as usize {
            let place = at - 20.0 + DVec2::new(19.0 * line as f64, 9.0 * shot as f64);
            views.push(view(place.extend(40.0), 0.0, pitch_deg));
        }
    }
    views
}
