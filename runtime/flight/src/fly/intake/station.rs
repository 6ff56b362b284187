//! The ground station: what it is shown of the flight as the camera's parameters, and what it may set. A setting is checked as
//! the mission's own, holds for this flight, and is written nowhere.

use config::mission::KeyframeSettings;
use config::settings::SettingError;
use config::training::TrainSettings;
use hal::camera::Picture;
use hal::error::HalError;
use hal::mavlink::dialect::MavSeverity;
use hal::mavlink_camera::ParameterId;
use hal::traits::{Camera, Clock, Link};
use survey::coverage::CoverageMap;

use super::{Intake, Phase};
use crate::fly::record::{Entry, Seen};

/// Between two looks at what the ground station is shown: it is told of changes, as often as it can read them.
const SHOW_EVERY_NS: u64 = 1_000_000_000;

/// Why a setting stays as it is.
#[derive(Debug, thiserror::Error)]
enum Refused {
    #[error(transparent)]
    Setting(#[from] SettingError),
    #[error("the flight is over")]
    Over,
    #[error("there are as many key frames as were planned for")]
    Full,
    #[error("training is over, the last checkpoint is kept")]
    NotTraining,
    #[error("it is no setting")]
    ReadOnly,
}

impl<L, C, K> Intake<L, C, K>
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    /// Says a line to the ground station.
    pub(super) fn say(&mut self, severity: MavSeverity, text: String) {
        self.vehicle.status_text(severity, &text);
        self.plan.recorder.note(self.vehicle.now_ns(), Entry::Words(severity, text));
    }

    /// What the ground station asks for; it is told whether that was obeyed.
    pub(super) fn set(&mut self, parameter: ParameterId, value: f32) {
        let name = parameter.row().name;
        let obeyed = self.obey(parameter, value);
        match &obeyed {
            Ok(()) => tracing::info!("the ground station set {name} to {value}, for this flight"),
            Err(why) => tracing::warn!("the ground station wants {name} = {value}, which stays as it is: {why}"),
        }
        self.vehicle.answer(parameter, obeyed.is_ok().then_some(value));
    }

    fn obey(&mut self, parameter: ParameterId, value: f32) -> Result<(), Refused> {
        let keyframes = match parameter {
            ParameterId::KeyframeDistance => KeyframeSettings { t_min_m: value, ..self.plan.keyframes },
            ParameterId::KeyframeRotation => KeyframeSettings { r_max_deg: value, ..self.plan.keyframes },
            ParameterId::TrainingSeconds => return self.obey_seconds(value),
            _ => return Err(Refused::ReadOnly),
        };
        keyframes.check()?;
        if !matches!(self.phase, Phase::Flying) {
            return Err(Refused::Over);
        }
        if self.selector.is_full() {
            return Err(Refused::Full);
        }
        self.plan.keyframes = keyframes;
        self.selector.follow(keyframes);
        Ok(())
    }

    fn obey_seconds(&mut self, value: f32) -> Result<(), Refused> {
        let seconds = (value > 0.0).then_some(f64::from(value));
        TrainSettings { seconds, ..TrainSettings::default() }.check()?;
        if !matches!(self.phase, Phase::Flying) {
            return Err(Refused::Over);
        }
        if self.end.told().training_over {
            return Err(Refused::NotTraining);
        }
        self.plan.training_seconds = seconds;
        self.end.ask_seconds(seconds);
        Ok(())
    }

    /// Shows the ground station how things stand, now and then.
    pub(super) fn show_station(&mut self) {
        let now_ns = self.clock.now_ns();
        if self.stationed_ns.is_some_and(|at| now_ns.saturating_sub(at) < SHOW_EVERY_NS) {
            return;
        }
        self.stationed_ns = Some(now_ns);
        let (told, keyframes) = (self.end.told(), self.plan.keyframes);
        let pictures = u32::try_from(self.vehicle.pictures()).unwrap_or(u32::MAX);
        let percent = |share: f64| (100.0 * share) as u32;
        for (parameter, value) in [
            (ParameterId::Overlap, percent(self.overlap())),
            (ParameterId::Activity, told.activity as u32),
            (ParameterId::Failsafe, told.rung as u32),
            (ParameterId::Pictures, pictures),
            (ParameterId::KeyFrames, told.key_frames),
            (ParameterId::Covered, self.shown.covered.unwrap_or(0)),
            (ParameterId::Gaussians, told.gaussians),
            (ParameterId::Trained, percent(told.progress.into())),
        ] {
            self.vehicle.show_count(parameter, value);
        }
        let seen = Seen { pictures: self.vehicle.pictures(), covered: self.shown.covered.unwrap_or(0) };
        self.plan.recorder.note(self.vehicle.now_ns(), Entry::State(told, seen));
        self.vehicle.show_setting(ParameterId::KeyframeDistance, keyframes.t_min_m);
        self.vehicle.show_setting(ParameterId::KeyframeRotation, keyframes.r_max_deg);
        self.vehicle.show_setting(ParameterId::TrainingSeconds, self.plan.training_seconds.unwrap_or(0.0) as f32);
    }

    /// How much of a key frame the next one shows again, flown along the picture's height above level ground, 0…1; 0 while
    /// nobody knows how high the aircraft is.
    fn overlap(&self) -> f64 {
        let base_m = self.selector.map().map(CoverageMap::base_m).or(self.vehicle.home_m());
        let (Some([_, _, up_m]), Some(base_m)) = (self.shown.at, base_m) else { return 0.0 };
        let lens = self.plan.intrinsics;
        let seen_m = (up_m - base_m) * f64::from(lens.height) / f64::from(lens.fy);
        if seen_m > 0.0 { (1.0 - f64::from(self.plan.keyframes.t_min_m) / seen_m).clamp(0.0, 1.0) } else { 0.0 }
    }
}
