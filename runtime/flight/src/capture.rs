//! Which pictures become key frames.
//!
//! The paper's rule (after NeuralRecon): a picture becomes a key frame when the camera moved more than `t_min` or
//! turned more than `r_max` since the last key frame. On top of it, a picture from where an earlier key frame already
//! stood sees nothing new and is skipped, so that a second pass over a covered line costs nothing; unless the map of the
//! flight's ground, where there is one, says that the ground in sight still lacks pictures. The same map is reported after
//! the flight.

use config::mission::KeyframeSettings;
use models::camera::{Intrinsics, Pose, View};
use serde::Serialize;
use survey::coverage::CoverageMap;
use survey::dataset::{Dataset, DatasetError, PoseSource};

/// What became of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// It is a key frame.
    Key,
    /// It moved and turned too little since the last key frame.
    TooClose,
    /// An earlier key frame was taken from there, and the ground in sight is covered.
    Covered,
    /// Its pose is not finite.
    BadPose,
    /// There are as many key frames as were planned for.
    Full,
    /// It would have been a key frame, but shows nothing or cannot be decoded.
    Unusable,
}

/// How many pictures met which fate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct KeyframeCounters {
    /// Became key frames.
    pub key: u32,
    /// Moved and turned too little.
    pub too_close: u32,
    /// Seen from there before.
    pub covered: u32,
    /// Pose not finite.
    pub bad_pose: u32,
    /// Beyond the planned number.
    pub full: u32,
    /// Showed nothing, or could not be decoded.
    pub unusable: u32,
}

/// Chooses key frames; its memory is planned from [`KeyframeSettings::max`].
#[derive(Debug)]
pub struct KeyframeSelector {
    settings: KeyframeSettings,
    chosen: Vec<Pose>,
    ground: Option<Ground>,
    counters: KeyframeCounters,
}

/// The ground as the key frames see it.
#[derive(Debug)]
struct Ground {
    map: CoverageMap,
    lens: Intrinsics,
    /// Key frames that the map knows. The newest is noted late: its picture may turn out to show nothing.
    noted: usize,
}

impl Ground {
    fn note(&mut self, chosen: &[Pose]) {
        for pose in &chosen[self.noted.min(chosen.len())..] {
            self.map.add(&View { intrinsics: self.lens, pose: *pose });
        }
        self.noted = chosen.len();
    }

    fn wants(&self, pose: &Pose) -> bool {
        self.map.wants(&View { intrinsics: self.lens, pose: *pose })
    }
}

impl KeyframeSelector {
    /// A selector that has chosen nothing yet.
    pub fn new(settings: KeyframeSettings) -> Self {
        let chosen = Vec::with_capacity(settings.max as usize);
        Self { settings, chosen, ground: None, counters: KeyframeCounters::default() }
    }

    /// Keeps a map of the ground that pictures of `lens` see, and asks it.
    pub fn over(&mut self, map: CoverageMap, lens: Intrinsics) {
        self.ground = Some(Ground { map, lens, noted: 0 });
    }

    /// Whether there is a map.
    pub fn has_ground(&self) -> bool {
        self.ground.is_some()
    }

    /// The map as it is: the newest key frame may not be in it yet.
    pub fn map(&self) -> Option<&CoverageMap> {
        self.ground.as_ref().map(|ground| &ground.map)
    }

    /// The map with all key frames noted, and their views; `None` without one.
    pub fn ground(&mut self) -> Option<(&CoverageMap, Vec<View>)> {
        let ground = self.ground.as_mut()?;
        ground.note(&self.chosen);
        let views = self.chosen.iter().map(|&pose| View { intrinsics: ground.lens, pose }).collect();
        Some((&ground.map, views))
    }

    /// Chooses by these distances and angles from now on; how many there may be stays as it was planned.
    pub fn follow(&mut self, settings: KeyframeSettings) {
        self.settings = KeyframeSettings { max: self.settings.max, ..settings };
    }

    /// There are as many as were planned for.
    pub fn is_full(&self) -> bool {
        self.chosen.len() >= self.settings.max as usize
    }

    /// Takes a key frame of an earlier run as chosen.
    pub fn restore(&mut self, pose: Pose) {
        if self.chosen.len() < self.settings.max as usize {
            self.chosen.push(pose);
        }
    }

    /// Decides on the next picture, in the order of capture.
    pub fn consider(&mut self, pose: &Pose) -> Decision {
        if let Some(ground) = &mut self.ground {
            ground.note(&self.chosen);
        }
        let decision = self.decide(pose);
        let counter = match decision {
            Decision::Key => &mut self.counters.key,
            Decision::TooClose => &mut self.counters.too_close,
            Decision::Covered => &mut self.counters.covered,
            Decision::BadPose => &mut self.counters.bad_pose,
            Decision::Full => &mut self.counters.full,
            Decision::Unusable => &mut self.counters.unusable,
        };
        *counter += 1;
        if decision == Decision::Key {
            self.chosen.push(*pose);
        }
        decision
    }

    /// Takes back the key frame chosen last: its picture turned out to show nothing.
    pub fn retract(&mut self) -> Decision {
        if self.chosen.pop().is_some() {
            self.counters.key = self.counters.key.saturating_sub(1);
            self.counters.unusable += 1;
        }
        Decision::Unusable
    }

    /// What has been counted so far.
    pub fn counters(&self) -> KeyframeCounters {
        self.counters
    }

    fn decide(&self, pose: &Pose) -> Decision {
        if !pose.center.is_finite() || !pose.rotation.is_finite() || pose.rotation.length_squared() < 1e-12 {
            return Decision::BadPose;
        }
        let Some(last) = self.chosen.last() else { return Decision::Key };
        let t_min = f64::from(self.settings.t_min_m);
        let r_max = f64::from(self.settings.r_max_deg).to_radians();
        let near = |other: &Pose, distance: f64| {
            other.center.distance(pose.center) <= distance && turned(&other.rotation, &pose.rotation) <= r_max
        };
        if near(last, t_min) {
            Decision::TooClose
        } else if self.settings.skip_covered
            && self.chosen.iter().any(|k| near(k, 0.5 * t_min))
            && !self.ground.as_ref().is_some_and(|g| g.wants(pose))
        {
            Decision::Covered
        } else if self.is_full() {
            Decision::Full
        } else {
            Decision::Key
        }
    }
}

/// Returns which frames of a data set `rule` makes key frames, and what became of all.
///
/// # Errors
/// A picture without the pose that was asked for.
pub fn choose(
    set: &Dataset,
    frames: Vec<usize>,
    poses: PoseSource,
    rule: KeyframeSettings,
) -> Result<(Vec<usize>, KeyframeCounters), DatasetError> {
    let mut selector = KeyframeSelector::new(rule);
    let mut chosen = Vec::with_capacity(frames.len());
    for i in frames {
        if selector.consider(&set.pose(i, poses)?.0) == Decision::Key {
            chosen.push(i);
        }
    }
    Ok((chosen, selector.counters()))
}

/// Angle between two attitudes, radians, 0…π.
fn turned(a: &glam::DQuat, b: &glam::DQuat) -> f64 {
    2.0 * a.normalize().dot(b.normalize()).abs().min(1.0).acos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    fn at(x: f64, yaw_deg: f64) -> Pose {
        Pose { rotation: DQuat::from_rotation_z(yaw_deg.to_radians()), center: DVec3::new(x, 0.0, 40.0) }
    }

    fn selector(max: u32) -> KeyframeSelector {
        KeyframeSelector::new(KeyframeSettings { max, ..KeyframeSettings::default() })
    }

    #[test]
    fn a_picture_is_a_key_frame_when_it_moved_or_turned_enough() {
        let mut s = selector(10);
        let fates: Vec<_> = [at(0.0, 0.0), at(4.9, 0.0), at(5.1, 0.0), at(5.2, 14.0), at(5.2, 16.0)]
            .iter()
            .map(|p| s.consider(p))
            .collect();
        use Decision::{Key, TooClose};
        assert_eq!(fates, [Key, TooClose, Key, TooClose, Key]);
    }

    #[test]
    fn a_second_pass_over_a_covered_line_is_skipped_unless_it_looks_elsewhere() {
        let mut s = selector(10);
        for x in [0.0, 6.0, 12.0] {
            assert_eq!(s.consider(&at(x, 0.0)), Decision::Key);
        }
        assert_eq!(s.consider(&at(1.0, 5.0)), Decision::Covered);
        assert_eq!(s.consider(&at(1.0, 180.0)), Decision::Key);
    }

    #[test]
    fn a_picture_that_shows_nothing_gives_its_place_to_the_next() {
        let mut s = selector(10);
        assert_eq!(s.consider(&at(0.0, 0.0)), Decision::Key);
        assert_eq!(s.consider(&at(6.0, 0.0)), Decision::Key);
        assert_eq!(s.retract(), Decision::Unusable);
        assert_eq!(s.consider(&at(7.0, 0.0)), Decision::Key);
        assert_eq!((s.counters().key, s.counters().unusable), (2, 1));
    }

    #[test]
    fn covered_places_are_captured_again_when_that_is_wanted() {
        let mut s = KeyframeSelector::new(KeyframeSettings { skip_covered: false, ..KeyframeSettings::default() });
        for x in [0.0, 6.0, 0.0] {
            assert_eq!(s.consider(&at(x, 0.0)), Decision::Key);
        }
    }

    /// Straight down from 40 m on a lens of 90°: 80 m of ground across.
    fn over_ground(max: u32) -> KeyframeSelector {
        let corners = [[-5.0, -5.0], [17.0, -5.0], [17.0, 5.0], [-5.0, 5.0]].map(glam::DVec2::from).to_vec();
        let region = survey::coverage::CoverageRegion::new(corners).expect("an area");
        let map = CoverageMap::new(&region, 0.0, config::coverage::CoverageSettings::default()).expect("a map");
        let mut s = selector(max);
        s.over(map, Intrinsics { width: 80, height: 80, fx: 40.0, fy: 40.0, cx: 40.0, cy: 40.0 });
        s
    }

    fn down(x: f64) -> Pose {
        Pose { rotation: DQuat::from_rotation_x(std::f64::consts::PI), center: DVec3::new(x, 0.0, 40.0) }
    }

    #[test]
    fn a_picture_from_an_earlier_place_is_taken_as_long_as_the_ground_there_lacks_pictures() {
        let mut s = over_ground(10);
        use Decision::{Covered, Key};
        // Three pictures are wanted: the third may come from near the first. The fourth brings neither number nor angle.
        let fates = [0.0, 6.0, 0.5, 6.4].map(|x| s.consider(&down(x)));
        assert_eq!(fates, [Key, Key, Key, Covered]);
        let (map, views) = s.ground().expect("a map");
        assert_eq!((map.covered_share(), map.pictures().0, views.len()), (0.0, 3, 3), "8.5° between them, 10° wanted");
        let mut s = over_ground(10);
        let fates = [0.0, 6.0, 12.0, 1.0].map(|x| s.consider(&down(x)));
        assert_eq!(fates, [Key, Key, Key, Covered]);
        assert_eq!(s.ground().expect("a map").0.covered_share(), 1.0);
    }

    #[test]
    fn a_picture_that_shows_nothing_never_reaches_the_map() {
        let mut s = over_ground(10);
        assert_eq!(s.consider(&down(0.0)), Decision::Key);
        s.retract();
        assert_eq!(s.consider(&down(0.5)), Decision::Key);
        assert_eq!(s.ground().expect("a map").0.pictures(), (1, 0));
        s.restore(down(9.0));
        assert_eq!(s.ground().expect("a map").0.pictures(), (2, 0));
    }

    #[test]
    fn poses_that_are_not_finite_and_pictures_beyond_the_plan_are_counted() {
        let mut s = selector(2);
        assert_eq!(s.consider(&at(f64::NAN, 0.0)), Decision::BadPose);
        assert_eq!(s.consider(&at(0.0, 0.0)), Decision::Key);
        assert_eq!(s.consider(&at(9.0, 0.0)), Decision::Key);
        assert_eq!(s.consider(&at(18.0, 0.0)), Decision::Full);
        assert_eq!(s.counters(), KeyframeCounters { key: 2, bad_pose: 1, full: 1, ..Default::default() });
    }
}
