//! The failsafe ladder in PX4's manner: flags in, one action out, worse always before better, and a way back only after the
//! cause was gone for a while. Pure: `update(time, state, flags)` decides, the runtime acts.

/// What to do, from harmless to final.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "std", derive(serde::Serialize))]
pub enum Action {
    /// All is well.
    #[default]
    Nominal,
    /// Tell the ground station, carry on.
    Warn,
    /// Train on pictures of half the size.
    HalfResolution,
    /// Fewer Gaussians.
    SmallerModel,
    /// No training; capture goes on.
    StopTraining,
    /// Write and offer the best model there is.
    UploadBest,
    /// Nothing but staying alive: the checkpoint is safe, wait for the ground.
    Hold,
}

impl Action {
    /// A word for logs and STATUSTEXT.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Nominal => "nominal",
            Self::Warn => "warn",
            Self::HalfResolution => "half resolution",
            Self::SmallerModel => "smaller model",
            Self::StopTraining => "stop training",
            Self::UploadBest => "upload best",
            Self::Hold => "hold",
        }
    }
}

/// What was seen; the runtime sets them every time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Flags {
    /// The autopilot is silent.
    pub link_lost: bool,
    /// No position fix, or one with an uncertainty beyond use.
    pub position_poor: bool,
    /// Pictures are announced but do not come.
    pub camera_silent: bool,
    /// Pictures are black, overexposed or undecodable.
    pub pictures_poor: bool,
    /// Training is behind its time budget.
    pub behind: bool,
    /// Training is so far behind that fewer Gaussians are needed.
    pub far_behind: bool,
    /// Memory is short.
    pub memory_low: bool,
    /// The disk is nearly full.
    pub disk_low: bool,
    /// The computer is too hot.
    pub hot: bool,
    /// The computer is about to throttle or shut down.
    pub very_hot: bool,
    /// The board lowers its own clock.
    pub throttled: bool,
    /// The board's supply is below what it needs.
    pub under_voltage: bool,
    /// Training failed (device lost, loss not finite) and its last checkpoint is good.
    pub training_failed: bool,
    /// Battery for the way home only.
    pub battery_low: bool,
}

/// Why the ladder stands where it stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "std", derive(serde::Serialize))]
pub enum Cause {
    /// [`Flags::battery_low`].
    BatteryLow,
    /// [`Flags::training_failed`].
    TrainingFailed,
    /// [`Flags::very_hot`].
    VeryHot,
    /// [`Flags::under_voltage`].
    UnderVoltage,
    /// [`Flags::memory_low`].
    MemoryLow,
    /// [`Flags::far_behind`].
    FarBehind,
    /// [`Flags::hot`].
    Hot,
    /// [`Flags::throttled`].
    Throttled,
    /// [`Flags::behind`].
    Behind,
    /// [`Flags::link_lost`].
    LinkLost,
    /// [`Flags::position_poor`].
    PositionPoor,
    /// [`Flags::camera_silent`].
    CameraSilent,
    /// [`Flags::pictures_poor`].
    PicturesPoor,
    /// [`Flags::disk_low`].
    DiskLow,
    /// Neither autopilot nor pictures for [`Timing::silent_ms`].
    Silence,
}

/// When a cause stops to count, in PX4's words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClearCondition {
    /// Once its flag was down for [`Timing::recovery_ms`], or at the landing.
    WhenConditionClears,
    /// Once its flag was down for [`Timing::recovery_ms`]; the landing changes nothing: what is short or hot in the air is so on the ground.
    OutlastsLanding,
    /// Not before the program starts afresh.
    Never,
}

impl Cause {
    /// A few words for logs and STATUSTEXT.
    pub fn name(self) -> &'static str {
        match self {
            Self::BatteryLow => "battery low",
            Self::TrainingFailed => "training failed",
            Self::VeryHot => "too hot",
            Self::UnderVoltage => "under-voltage",
            Self::MemoryLow => "memory short",
            Self::FarBehind => "far behind",
            Self::Hot => "hot",
            Self::Throttled => "throttled",
            Self::Behind => "behind",
            Self::LinkLost => "autopilot silent",
            Self::PositionPoor => "position poor",
            Self::CameraSilent => "no pictures",
            Self::PicturesPoor => "pictures poor",
            Self::DiskLow => "disk nearly full",
            Self::Silence => "nothing comes any more",
        }
    }

    /// When it stops to count.
    pub fn clears(self) -> ClearCondition {
        match self {
            Self::BatteryLow | Self::VeryHot | Self::UnderVoltage => ClearCondition::OutlastsLanding,
            Self::TrainingFailed => ClearCondition::Never,
            _ => ClearCondition::WhenConditionClears,
        }
    }
}

/// A cause and what it asks for.
struct Rule {
    cause: Cause,
    seen: fn(&Flags) -> bool,
    action: Action,
    /// It must hold this long before it counts, ms.
    after_ms: u32,
}

const fn rule(cause: Cause, seen: fn(&Flags) -> bool, action: Action, after_ms: u32) -> Rule {
    Rule { cause, seen, action, after_ms }
}

/// Ordered as they are reported when several ask for the same.
const RULES: &[Rule] = &[
    rule(Cause::BatteryLow, |f| f.battery_low, Action::UploadBest, 2_000),
    rule(Cause::TrainingFailed, |f| f.training_failed, Action::UploadBest, 0),
    rule(Cause::VeryHot, |f| f.very_hot, Action::StopTraining, 1_000),
    rule(Cause::UnderVoltage, |f| f.under_voltage, Action::StopTraining, 2_000),
    rule(Cause::MemoryLow, |f| f.memory_low, Action::SmallerModel, 1_000),
    rule(Cause::FarBehind, |f| f.far_behind, Action::SmallerModel, 5_000),
    rule(Cause::Hot, |f| f.hot, Action::HalfResolution, 5_000),
    rule(Cause::Throttled, |f| f.throttled, Action::HalfResolution, 5_000),
    rule(Cause::Behind, |f| f.behind, Action::HalfResolution, 5_000),
    rule(Cause::LinkLost, |f| f.link_lost, Action::Warn, 0),
    rule(Cause::PositionPoor, |f| f.position_poor, Action::Warn, 2_000),
    rule(Cause::CameraSilent, |f| f.camera_silent, Action::Warn, 0),
    rule(Cause::PicturesPoor, |f| f.pictures_poor, Action::Warn, 0),
    rule(Cause::DiskLow, |f| f.disk_low, Action::Warn, 1_000),
];

/// How patient the ladder is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// Causes must be gone this long before a step back, ms: a flapping flag must not flap the training.
    pub recovery_ms: u64,
    /// Without autopilot or pictures for this long the best model is offered, ms.
    pub silent_ms: u64,
    /// After the best model was offered and nothing got better for this long, hold, ms.
    pub hold_after_ms: u64,
}

impl Default for Timing {
    fn default() -> Self {
        Self { recovery_ms: 10_000, silent_ms: 60_000, hold_after_ms: 30_000 }
    }
}

#[cfg(feature = "std")]
impl From<&config::failsafe::FailsafeSettings> for Timing {
    fn from(settings: &config::failsafe::FailsafeSettings) -> Self {
        let ms = |seconds: f32| (f64::from(seconds.max(0.0)) * 1e3) as u64;
        Self {
            recovery_ms: ms(settings.recovery_s),
            silent_ms: ms(settings.silent_s),
            hold_after_ms: ms(settings.hold_after_s),
        }
    }
}

/// Between two updates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct State {
    timing: Timing,
    action: Action,
    cause: Option<Cause>,
    since_ms: u64,
    calm_since_ms: Option<u64>,
    rule_since_ms: [Option<u64>; RULES.len()],
    silent_since_ms: Option<u64>,
}

impl State {
    /// At the foot of the ladder.
    pub fn new(timing: Timing) -> Self {
        Self { timing, ..Self::default() }
    }

    /// What to do now.
    pub fn action(&self) -> Action {
        self.action
    }

    /// Whether training must not go on after the landing either.
    pub fn forbids_training(&self) -> bool {
        self.action >= Action::StopTraining
            && self.cause.is_some_and(|cause| cause.clears() == ClearCondition::OutlastsLanding)
    }

    /// Why.
    pub fn cause(&self) -> Option<Cause> {
        self.cause
    }
}

/// The next state. `time_ms` is monotonic.
pub fn update(time_ms: u64, state: &State, flags: &Flags) -> State {
    let mut next = *state;
    let timing = state.timing;
    let mut asked = (Action::Nominal, None);
    for (rule, since) in RULES.iter().zip(&mut next.rule_since_ms) {
        if !(rule.seen)(flags) {
            *since = None;
            continue;
        }
        let held = time_ms.saturating_sub(*since.get_or_insert(time_ms));
        if held >= rule.after_ms.into() && rule.action > asked.0 {
            asked = (rule.action, Some(rule.cause));
        }
    }
    if flags.link_lost || flags.camera_silent {
        let since = *next.silent_since_ms.get_or_insert(time_ms);
        if time_ms.saturating_sub(since) >= timing.silent_ms && Action::UploadBest > asked.0 {
            asked = (Action::UploadBest, Some(Cause::Silence));
        }
    } else {
        next.silent_since_ms = None;
    }
    if asked.0 == Action::UploadBest
        && state.action >= Action::UploadBest
        && time_ms.saturating_sub(state.since_ms) >= timing.hold_after_ms
    {
        asked.0 = Action::Hold;
    }
    let stays = state.action == Action::Hold || state.cause.is_some_and(|c| c.clears() == ClearCondition::Never);
    if asked.0 > state.action {
        // Up the ladder at once.
        (next.action, next.cause) = asked;
        next.since_ms = time_ms;
        next.calm_since_ms = None;
    } else if asked.0 == state.action || stays {
        next.calm_since_ms = None;
    } else {
        let calm = *next.calm_since_ms.get_or_insert(time_ms);
        if time_ms.saturating_sub(calm) >= timing.recovery_ms {
            (next.action, next.cause) = asked;
            next.since_ms = time_ms;
            next.calm_since_ms = None;
        }
    }
    next
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(mut state: State, from_ms: u64, to_ms: u64, flags: Flags) -> State {
        for t in (from_ms..=to_ms).step_by(100) {
            state = update(t, &state, &flags);
        }
        state
    }

    #[test]
    fn each_cause_asks_for_its_action_and_the_worst_wins() {
        let hot = Flags { hot: true, ..Flags::default() };
        assert_eq!(run(State::default(), 0, 4_000, hot).action(), Action::Nominal, "not yet");
        let state = run(State::default(), 0, 6_000, hot);
        assert_eq!((state.action(), state.cause()), (Action::HalfResolution, Some(Cause::Hot)));
        let both = Flags { memory_low: true, ..hot };
        let state = run(state, 6_100, 8_000, both);
        assert_eq!((state.action(), state.cause()), (Action::SmallerModel, Some(Cause::MemoryLow)));
    }

    #[test]
    fn the_way_back_takes_ten_calm_seconds() {
        let state = run(State::default(), 0, 2_000, Flags { very_hot: true, ..Flags::default() });
        assert_eq!(state.action(), Action::StopTraining);
        let state = run(state, 2_100, 11_000, Flags::default());
        assert_eq!(state.action(), Action::StopTraining, "still cooling");
        assert_eq!(run(state, 11_100, 13_000, Flags::default()).action(), Action::Nominal);
    }

    #[test]
    fn a_flapping_link_only_warns_and_a_dead_one_ends_in_hold() {
        let mut state = State::default();
        let lost = Flags { link_lost: true, ..Flags::default() };
        for i in 0..60u64 {
            let flags = if i % 2 == 0 { lost } else { Flags::default() };
            state = run(state, i * 2_000, i * 2_000 + 1_900, flags);
        }
        assert_eq!(state.action(), Action::Warn);
        let state = run(state, 120_000, 185_000, lost);
        assert_eq!(state.action(), Action::UploadBest);
        let state = run(state, 185_100, 220_000, lost);
        assert_eq!(state.action(), Action::Hold);
        assert_eq!(run(state, 220_100, 300_000, Flags::default()).action(), Action::Hold, "final");
    }

    #[test]
    fn a_low_battery_forbids_training_on_the_ground_too_and_a_silent_autopilot_does_not() {
        let low = run(State::default(), 0, 3_000, Flags { battery_low: true, ..Flags::default() });
        assert_eq!((low.action(), low.forbids_training()), (Action::UploadBest, true));
        let held = run(low, 3_100, 60_000, Flags { battery_low: true, ..Flags::default() });
        assert_eq!((held.action(), held.forbids_training()), (Action::Hold, true));
        let lost = run(State::default(), 0, 70_000, Flags { link_lost: true, ..Flags::default() });
        assert_eq!((lost.action(), lost.forbids_training()), (Action::UploadBest, false));
        let warm = run(State::default(), 0, 6_000, Flags { hot: true, ..Flags::default() });
        assert!(!warm.forbids_training());
    }

    #[test]
    fn it_is_pure_and_time_that_stands_still_does_no_harm() {
        let flags = Flags { training_failed: true, ..Flags::default() };
        let state = update(5, &State::default(), &flags);
        assert_eq!(state, update(5, &State::default(), &flags));
        assert_eq!(update(5, &state, &flags).action(), Action::UploadBest);
        assert_eq!(update(0, &state, &flags).action(), Action::UploadBest, "a clock going back");
    }

    #[test]
    fn an_undervolted_board_stops_training_and_a_throttled_one_halves_the_resolution() {
        let weak = Flags { under_voltage: true, ..Flags::default() };
        let state = run(State::default(), 0, 2_500, weak);
        assert_eq!((state.action(), state.cause()), (Action::StopTraining, Some(Cause::UnderVoltage)));
        assert!(state.forbids_training(), "the supply is no better on the ground");
        let state = run(State::default(), 0, 6_000, Flags { throttled: true, ..Flags::default() });
        assert_eq!((state.action(), state.cause()), (Action::HalfResolution, Some(Cause::Throttled)));
        let state = run(State::default(), 0, 2_000, Flags { disk_low: true, ..Flags::default() });
        assert_eq!((state.action(), state.cause()), (Action::Warn, Some(Cause::DiskLow)));
    }

    #[test]
    fn a_failed_training_is_not_forgotten_and_the_settings_set_the_pace() {
        let failed = run(State::default(), 0, 100, Flags { training_failed: true, ..Flags::default() });
        assert_eq!(run(failed, 200, 60_000, Flags::default()).cause(), Some(Cause::TrainingFailed));
        let quick = State::new(Timing { recovery_ms: 500, ..Timing::default() });
        let hot = run(quick, 0, 2_000, Flags { very_hot: true, ..Flags::default() });
        assert_eq!(hot.action(), Action::StopTraining);
        assert_eq!(run(hot, 2_100, 2_700, Flags::default()).action(), Action::Nominal);
    }
}
