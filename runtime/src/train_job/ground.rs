//! The ground below a folder's pictures: what they cover of it, judged by their settled poses over the heights that were
//! reconstructed.

use config::coverage::CoverageSettings;
use geometry::polygon::hull;
use glam::{DVec2, Vec3};
use models::camera::View;
use models::formats::model::ModelHeader;
use survey::coverage::{CoverageMap, CoverageRegion, Heights};

use flight::coverage::Coverage;

/// Pictures that look down by less than this per unit of length (15° below the horizon) show a thing, not the ground.
const DOWN: f64 = 0.25;

/// What the views of `header` cover of its region, or where it has none of the ground below the cameras; `None` where most of
/// them do not look down, or there is no ground to speak of.
pub(super) fn coverage(header: &ModelHeader, means: &[[f32; 3]], rules: CoverageSettings) -> Option<Coverage> {
    let views: Vec<&View> = header.views.iter().map(|(_, view)| view).filter(|v| v.is_usable()).collect();
    let down = views.iter().filter(|v| v.pose.forward().z < -DOWN).count();
    if 2 * down < views.len() {
        return None;
    }
    let corners: Vec<DVec2> = match header.region.len() {
        0..3 => hull(views.iter().map(|v| v.pose.center.truncate()).collect()),
        _ => header.region.iter().map(|c| DVec2::from(*c)).collect(),
    };
    let region = CoverageRegion::new(corners).ok()?;
    let mut map = CoverageMap::new(&region, rules.ground_m.unwrap_or(0.0).into(), rules).ok()?;
    if rules.ground_m.is_none() {
        let points: Vec<Vec3> = means.iter().map(|m| Vec3::from(*m)).collect();
        let heights = Heights::of(&points, map.grid())?;
        let (low, high) = region.bounds();
        map = CoverageMap::new(&region, heights.at(0.5 * (low + high)), rules).ok()?.over(|p| heights.at(p));
    }
    views.into_iter().for_each(|view| map.add(view));
    Some(Coverage::of(map, header.origin))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use models::camera::{Intrinsics, Pose};
    use models::formats::telemetry::dji_rotation;

    const LENS: Intrinsics = Intrinsics { width: 80, height: 60, fx: 60.0, fy: 60.0, cx: 40.0, cy: 30.0 };

    /// Six by six pictures 8 m apart, 40 m above ground that lies at 700 m; those at `without` are missing.
    fn header(pitch_deg: f64, without: &[usize]) -> ModelHeader {
        let views = (0..36usize).filter(|i| !without.contains(i)).map(|i| {
            let center = DVec3::new((i % 6) as f64 * 8.0, (i / 6) as f64 * 8.0, 740.0);
            let pose = Pose { rotation: dji_rotation(0.0, pitch_deg, 0.0), center };
            (format!("{i}.jpg"), View { intrinsics: LENS, pose })
        });
        ModelHeader { views: views.collect(), ..ModelHeader::default() }
    }

    /// Points on the ground, and a tenth of them on roofs.
    fn means() -> Vec<[f32; 3]> {
        (0..4000)
            .map(|i| {
                let roof = if i % 10 == 0 { 6.0 } else { 0.0 };
                [(i % 80) as f32 - 20.0, (i / 80) as f32 - 5.0, 700.0 + roof]
            })
            .collect()
    }

    #[test]
    fn a_folder_is_judged_over_the_ground_that_was_reconstructed() {
        let rules = CoverageSettings::default();
        let whole = coverage(&header(-90.0, &[]), &means(), rules).expect("a map");
        assert_eq!((whole.percent(), whole.gaps.len()), (100, 0));
        assert!((whole.map.base_m() - 700.0).abs() < 0.5, "{}", whole.map.base_m());
        let middle: Vec<usize> = (0..36).filter(|i| i / 6 < 5).collect();
        let rest = coverage(&header(-90.0, &middle), &means(), rules);
        assert!(rest.is_none(), "cameras on one line have no ground between them");
    }

    #[test]
    fn pictures_of_a_thing_have_no_coverage() {
        assert!(coverage(&header(-5.0, &[]), &means(), CoverageSettings::default()).is_none());
        assert!(coverage(&header(-90.0, &[]), &[], CoverageSettings::default()).is_none());
    }
}
