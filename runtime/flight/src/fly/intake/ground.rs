//! The ground that the key frames see: a map of it while they come, and what it lacks at the end.

use glam::DVec2;
use hal::camera::Picture;
use hal::error::HalError;
use hal::mavlink::dialect::MavSeverity;
use hal::traits::{Camera, Clock, Link};
use survey::coverage::{CoverageMap, CoverageRegion};

use super::Intake;
use crate::coverage::Coverage;

impl<L, C, K> Intake<L, C, K>
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    /// Begins a map of the ground once its height is known: with the first picture the autopilot has said where home is.
    pub(super) fn look_at_ground(&mut self) {
        if self.selector.has_ground() {
            return;
        }
        let corners = self.plan.region.iter().map(|c| DVec2::from(*c)).collect();
        let height_m = self.plan.coverage.ground_m.map(f64::from).or(self.vehicle.home_m()).unwrap_or(0.0);
        match CoverageRegion::new(corners).and_then(|region| CoverageMap::new(&region, height_m, self.plan.coverage)) {
            Ok(map) => self.selector.over(map, self.plan.intrinsics),
            Err(e) => tracing::debug!("no map of the ground: {e}"),
        }
    }

    /// What the key frames cover, and how to get the rest.
    pub(super) fn survey(&mut self) -> Option<Coverage> {
        let (map, flown) = self.selector.ground()?;
        let home_m = self.vehicle.home_m().unwrap_or(map.base_m());
        let found = Coverage::of(map.clone(), Some(self.plan.vehicle.origin));
        Some(found.with_reflight(&flown, self.plan.keyframes.t_min_m.into(), home_m))
    }

    /// Says it to the ground control station: whoever has to fly again is still there.
    pub(super) fn tell_coverage(&mut self) {
        self.counters.coverage = self.survey();
        if let Some(coverage) = &self.counters.coverage {
            self.shown.coverage(coverage);
            let line = coverage.line();
            tracing::info!("{line}");
            let severity = match coverage.gaps.is_empty() {
                true => MavSeverity::MAV_SEVERITY_INFO,
                false => MavSeverity::MAV_SEVERITY_NOTICE,
            };
            self.say(severity, line);
        }
    }
}
