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
    pub fn name(self) -> &'static str {
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
    /// Training cannot keep its budget even at half resolution.
    pub far_behind: bool,
    /// Memory is short.
    pub memory_low: bool,
    /// The computer is too hot.
    pub hot: bool,
    /// The computer is about to throttle or shut down.
    pub very_hot: bool,
    /// Training failed (device lost, loss not finite) and its last checkpoint is good.
    pub training_failed: bool,
    /// Battery for the way home only.
    pub battery_low: bool,
    /// Landed or about to lose power.
    pub ending: bool,
}

/// A cause and what it asks for.
struct Rule {
    name: &'static str,
    seen: fn(&Flags) -> bool,
    action: Action,
    /// It must hold this long before it counts, ms.
    after_ms: u32,
}

/// Causes that outlast the landing: what is short or hot in the air is so on the ground.
const LASTING: [&str; 2] = ["battery low", "too hot"];

/// Ordered as they are reported when several ask for the same.
const RULES: &[Rule] = &[
    Rule { name: "mission ends", seen: |f| f.ending, action: Action::UploadBest, after_ms: 0 },
    Rule { name: "battery low", seen: |f| f.battery_low, action: Action::UploadBest, after_ms: 2_000 },
    Rule { name: "training failed", seen: |f| f.training_failed, action: Action::UploadBest, after_ms: 0 },
    Rule { name: "too hot", seen: |f| f.very_hot, action: Action::StopTraining, after_ms: 1_000 },
    Rule { name: "memory short", seen: |f| f.memory_low, action: Action::SmallerModel, after_ms: 1_000 },
    Rule { name: "far behind", seen: |f| f.far_behind, action: Action::SmallerModel, after_ms: 5_000 },
    Rule { name: "hot", seen: |f| f.hot, action: Action::HalfResolution, after_ms: 5_000 },
    Rule { name: "behind", seen: |f| f.behind, action: Action::HalfResolution, after_ms: 5_000 },
    Rule { name: "autopilot silent", seen: |f| f.link_lost, action: Action::Warn, after_ms: 0 },
    Rule { name: "position poor", seen: |f| f.position_poor, action: Action::Warn, after_ms: 2_000 },
    Rule { name: "no pictures", seen: |f| f.camera_silent, action: Action::Warn, after_ms: 0 },
    Rule { name: "pictures poor", seen: |f| f.pictures_poor, action: Action::Warn, after_ms: 0 },
];

/// Causes must be gone this long before a step back, ms: a flapping flag must not flap the training.
const RECOVERY_MS: u64 = 10_000;
/// Capture without autopilot or pictures for this long has ended: offer what there is.
const SILENT_MS: u64 = 60_000;
/// After the best model was offered and nothing got better, hold.
const HOLD_AFTER_MS: u64 = 30_000;

/// Between two updates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct State {
    action: Action,
    cause: Option<&'static str>,
    since_ms: u64,
    calm_since_ms: Option<u64>,
    rule_since_ms: [Option<u64>; RULES.len()],
    silent_since_ms: Option<u64>,
}

impl State {
    /// What to do now.
    pub fn action(&self) -> Action {
        self.action
    }

    /// Whether training must not go on after the landing either.
    pub fn forbids_training(&self) -> bool {
        self.action >= Action::StopTraining && self.cause.is_some_and(|cause| LASTING.contains(&cause))
    }

    /// Why, in a few words.
    pub fn cause(&self) -> Option<&'static str> {
        self.cause
    }
}

/// The next state. `time_ms` is monotonic.
pub fn update(time_ms: u64, state: &State, flags: &Flags) -> State {
    let mut next = *state;
    let mut asked = (Action::Nominal, None);
    for (rule, since) in RULES.iter().zip(&mut next.rule_since_ms) {
        if !(rule.seen)(flags) {
            *since = None;
            continue;
        }
        let held = time_ms.saturating_sub(*since.get_or_insert(time_ms));
        if held >= rule.after_ms.into() && rule.action > asked.0 {
            asked = (rule.action, Some(rule.name));
        }
    }
    if flags.link_lost || flags.camera_silent {
        let since = *next.silent_since_ms.get_or_insert(time_ms);
        if time_ms.saturating_sub(since) >= SILENT_MS && Action::UploadBest > asked.0 {
            asked = (Action::UploadBest, Some("nothing comes any more"));
        }
    } else {
        next.silent_since_ms = None;
    }
    if asked.0 == Action::UploadBest
        && state.action >= Action::UploadBest
        && time_ms.saturating_sub(state.since_ms) >= HOLD_AFTER_MS
    {
        asked.0 = Action::Hold;
    }
    if asked.0 > state.action {
        // Up the ladder at once.
        (next.action, next.cause) = asked;
        next.since_ms = time_ms;
        next.calm_since_ms = None;
    } else if asked.0 == state.action || state.action == Action::Hold {
        // Hold is final until the runtime starts afresh.
        next.calm_since_ms = None;
    } else {
        let calm = *next.calm_since_ms.get_or_insert(time_ms);
        if time_ms.saturating_sub(calm) >= RECOVERY_MS {
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
        assert_eq!((state.action(), state.cause()), (Action::HalfResolution, Some("hot")));
        let both = Flags { memory_low: true, ..hot };
        let state = run(state, 6_100, 8_000, both);
        assert_eq!((state.action(), state.cause()), (Action::SmallerModel, Some("memory short")));
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
        assert!(LASTING.iter().all(|cause| RULES.iter().any(|rule| rule.name == *cause)));
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
}
