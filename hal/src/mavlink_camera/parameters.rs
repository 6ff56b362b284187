//! What a ground station sees and sets of the job, as extended parameters (PARAM_EXT): one table, of which the camera
//! definition file is made as well. What is set is bounded here, checked as the mission's own setting by the runtime, and
//! acknowledged once that has obeyed.

use crate::failsafe::Action;
use crate::mavlink::dialect::{
    MavParamExtType, PARAM_EXT_ACK_DATA, PARAM_EXT_REQUEST_READ_DATA, PARAM_EXT_SET_DATA, PARAM_EXT_VALUE_DATA,
    ParamAck,
};

/// What the job does while the aircraft flies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Activity {
    /// Nothing was photographed yet.
    #[default]
    Listening,
    /// Too few key frames for a model.
    Collecting,
    /// Poses, depth and Gaussians of new key frames.
    Building,
    /// Optimiser steps.
    Training,
}

impl Activity {
    /// A few words for people.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Listening => "listening",
            Self::Collecting => "taking key frames",
            Self::Building => "building a model",
            Self::Training => "training in flight",
        }
    }
}

/// One parameter, by its place in [`TABLE`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ParameterId {
    /// `keyframes.t_min_m` of the mission.
    KeyframeDistance,
    /// `keyframes.r_max_deg`.
    KeyframeRotation,
    /// `training.seconds`; 0: the steps alone decide.
    TrainingSeconds,
    /// How much of a key frame the next one shows again, percent.
    Overlap,
    /// [`Activity`].
    Activity,
    /// [`Action`]: the rung of the failsafe ladder.
    Failsafe,
    /// Complete pictures from the camera.
    Pictures,
    /// Key frames.
    KeyFrames,
    /// Ground of the region that is covered, percent.
    Covered,
    /// Gaussians of the model.
    Gaussians,
    /// Share of the schedule that is over, percent.
    Trained,
}

/// Parameters there are.
pub const COUNT: usize = 11;

/// What a parameter's value is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    /// A REAL32 that is set: least, most, default.
    Set(f32, f32, f32),
    /// A UINT32 that is read, and the most it can be.
    Count(u32),
    /// A UINT32 that is read and stands for one of these words.
    Word(&'static [&'static str]),
}

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameter {
    /// Name on the wire, 16 bytes at most.
    pub name: &'static str,
    /// What QGroundControl writes beside it.
    pub label: &'static str,
    /// Unit; empty: none.
    pub unit: &'static str,
    /// What it holds.
    pub kind: Kind,
}

const ACTIVITIES: [&str; 4] =
    [Activity::Listening.name(), Activity::Collecting.name(), Activity::Building.name(), Activity::Training.name()];
const RUNGS: [&str; 7] = [
    Action::Nominal.name(),
    Action::Warn.name(),
    Action::HalfResolution.name(),
    Action::SmallerModel.name(),
    Action::StopTraining.name(),
    Action::UploadBest.name(),
    Action::Hold.name(),
];

const fn row(name: &'static str, label: &'static str, unit: &'static str, kind: Kind) -> Parameter {
    Parameter { name, label, unit, kind }
}

/// Clients read bounds of counts as `int` (MAVSDK 4.1 dies of more).
const MOST: u32 = i32::MAX as u32;

/// All of them, in the order of [`ParameterId`]. Defaults are the mission's, which a test compares; bounds lie within the
/// mission's: a kilometre between key frames gives none, and nobody trains for more than a day on board.
pub const TABLE: [Parameter; COUNT] = [
    row("KF_DISTANCE", "Key-frame distance", "m", Kind::Set(0.0, 1000.0, 5.0)),
    row("KF_ROTATION", "Key-frame rotation", "deg", Kind::Set(0.1, 180.0, 15.0)),
    row("TRAIN_SECONDS", "Training time (0: steps decide)", "s", Kind::Set(0.0, 86_400.0, 0.0)),
    row("KF_OVERLAP", "Overlap of key frames", "%", Kind::Count(100)),
    row("STATE", "State", "", Kind::Word(&ACTIVITIES)),
    row("FAILSAFE", "Failsafe", "", Kind::Word(&RUNGS)),
    row("PICTURES", "Pictures", "", Kind::Count(MOST)),
    row("KEY_FRAMES", "Key frames", "", Kind::Count(MOST)),
    row("COVERED", "Region covered", "%", Kind::Count(100)),
    row("GAUSSIANS", "Gaussians", "", Kind::Count(MOST)),
    row("TRAINED", "Training done", "%", Kind::Count(100)),
];

impl Parameter {
    fn wire_type(&self) -> MavParamExtType {
        match self.kind {
            Kind::Set(..) => MavParamExtType::MAV_PARAM_EXT_TYPE_REAL32,
            Kind::Count(_) | Kind::Word(_) => MavParamExtType::MAV_PARAM_EXT_TYPE_UINT32,
        }
    }

    fn default_bits(&self) -> u32 {
        if let Kind::Set(_, _, default) = self.kind { default.to_bits() } else { 0 }
    }
}

impl ParameterId {
    const ALL: [Self; COUNT] = [
        Self::KeyframeDistance,
        Self::KeyframeRotation,
        Self::TrainingSeconds,
        Self::Overlap,
        Self::Activity,
        Self::Failsafe,
        Self::Pictures,
        Self::KeyFrames,
        Self::Covered,
        Self::Gaussians,
        Self::Trained,
    ];

    /// Its row.
    pub const fn row(self) -> &'static Parameter {
        &TABLE[self as usize]
    }

    fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|id| id.row().name == name)
    }
}

/// What came of a request to set a parameter.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Asked {
    /// The answer is known.
    Answer(PARAM_EXT_ACK_DATA),
    /// The runtime has to decide.
    Set(ParameterId, f32),
}

/// The values, and which of them are to be sent.
#[derive(Debug)]
pub(super) struct Parameters {
    bits: [u32; COUNT],
    due: [bool; COUNT],
    /// Somebody has asked: changes are told from then on.
    is_heard: bool,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { bits: TABLE.map(|row| row.default_bits()), due: [false; COUNT], is_heard: false }
    }
}

impl Parameters {
    /// The value is this now; whoever has asked before is told.
    pub(super) fn note_count(&mut self, id: ParameterId, value: u32) {
        let most = match id.row().kind {
            Kind::Count(most) => most,
            Kind::Word(words) => words.len() as u32 - 1,
            Kind::Set(..) => return,
        };
        self.note(id, value.min(most));
    }

    /// As [`Parameters::note_count`], of one that is set; a value beyond the table's bounds is sent as the mission has it.
    pub(super) fn note_real(&mut self, id: ParameterId, value: f32) {
        if matches!(id.row().kind, Kind::Set(..)) {
            self.note(id, value.to_bits());
        }
    }

    fn note(&mut self, id: ParameterId, bits: u32) {
        let place = id as usize;
        self.due[place] |= self.is_heard && self.bits[place] != bits;
        self.bits[place] = bits;
    }

    /// PARAM_EXT_REQUEST_LIST.
    pub(super) fn list(&mut self) {
        (self.is_heard, self.due) = (true, [true; COUNT]);
    }

    /// PARAM_EXT_REQUEST_READ, by index or, when that is −1, by name. What is not there has no answer in this protocol.
    pub(super) fn read(&mut self, m: &PARAM_EXT_REQUEST_READ_DATA) {
        let place = match usize::try_from(m.param_index) {
            Ok(index) => Some(index),
            Err(_) => m.param_id.to_str().ok().and_then(ParameterId::named).map(|id| id as usize),
        };
        if let Some(due) = place.and_then(|place| self.due.get_mut(place)) {
            (*due, self.is_heard) = (true, true);
        }
    }

    /// PARAM_EXT_SET.
    pub(super) fn set(&mut self, m: &PARAM_EXT_SET_DATA) -> Asked {
        let Some(id) = m.param_id.to_str().ok().and_then(ParameterId::named) else {
            return Asked::Answer(PARAM_EXT_ACK_DATA {
                param_id: m.param_id,
                param_value: m.param_value,
                param_type: m.param_type,
                param_result: ParamAck::PARAM_ACK_FAILED,
            });
        };
        let [a, b, c, d, ..] = *m.param_value;
        let value = f32::from_le_bytes([a, b, c, d]);
        match id.row().kind {
            Kind::Set(least, most, _) if m.param_type == id.row().wire_type() && (least..=most).contains(&value) => {
                // A request that is repeated because its answer was lost.
                if value.to_bits() == self.bits[id as usize] {
                    return Asked::Answer(self.ack(id, ParamAck::PARAM_ACK_ACCEPTED));
                }
                Asked::Set(id, value)
            }
            // QGroundControl puts the old value back on this answer, which it does not on FAILED.
            _ => Asked::Answer(self.ack(id, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED)),
        }
    }

    /// The runtime has obeyed (`Some` with what it now is), or cannot.
    pub(super) fn answer(&mut self, id: ParameterId, obeyed: Option<f32>) -> PARAM_EXT_ACK_DATA {
        // For the other ground stations; and, of what was refused, for those that leave what was typed on the screen.
        self.due[id as usize] = true;
        match obeyed {
            Some(value) => {
                self.bits[id as usize] = value.to_bits();
                self.ack(id, ParamAck::PARAM_ACK_ACCEPTED)
            }
            None => self.ack(id, ParamAck::PARAM_ACK_FAILED),
        }
    }

    fn ack(&self, id: ParameterId, param_result: ParamAck) -> PARAM_EXT_ACK_DATA {
        PARAM_EXT_ACK_DATA {
            param_id: id.row().name.into(),
            param_value: self.on_wire(id).into(),
            param_type: id.row().wire_type(),
            param_result,
        }
    }

    /// The bytes of the number, as QGroundControl's and MAVSDK's unions have them.
    fn on_wire(&self, id: ParameterId) -> [u8; 128] {
        let mut bytes = [0; 128];
        bytes[..4].copy_from_slice(&self.bits[id as usize].to_le_bytes());
        bytes
    }

    /// The next value to send.
    pub(super) fn next(&mut self) -> Option<PARAM_EXT_VALUE_DATA> {
        let place = self.due.iter().position(|due| *due)?;
        self.due[place] = false;
        let id = ParameterId::ALL[place];
        Some(PARAM_EXT_VALUE_DATA {
            param_id: id.row().name.into(),
            param_value: self.on_wire(id).into(),
            param_type: id.row().wire_type(),
            param_count: COUNT as u16,
            param_index: place as u16,
        })
    }
}

#[cfg(all(test, feature = "std"))]
mod tests {
    use config::mission::KeyframeSettings;
    use config::training::TrainSettings;

    use super::*;

    #[test]
    fn the_table_is_in_the_order_of_its_ids_and_every_name_fits_the_wire() {
        for (place, id) in ParameterId::ALL.into_iter().enumerate() {
            assert_eq!(id as usize, place);
            assert!((1..=16).contains(&id.row().name.len()), "{}", id.row().name);
            assert_eq!(ParameterId::named(id.row().name), Some(id));
        }
    }

    #[test]
    fn defaults_are_the_missions_and_bounds_lie_within_the_missions() {
        let (keyframes, training) = (KeyframeSettings::default(), TrainSettings::default());
        for (id, default) in [
            (ParameterId::KeyframeDistance, keyframes.t_min_m),
            (ParameterId::KeyframeRotation, keyframes.r_max_deg),
            (ParameterId::TrainingSeconds, training.seconds.unwrap_or(0.0) as f32),
        ] {
            let Kind::Set(least, most, ours) = id.row().kind else { panic!("{id:?} is not set") };
            assert_eq!(ours, default, "{id:?}");
            for value in [least, most] {
                let seconds = (value > 0.0).then_some(f64::from(value));
                let checked = match id {
                    ParameterId::KeyframeDistance => KeyframeSettings { t_min_m: value, ..keyframes }.check(),
                    ParameterId::KeyframeRotation => KeyframeSettings { r_max_deg: value, ..keyframes }.check(),
                    _ => TrainSettings { seconds, ..training.clone() }.check(),
                };
                assert_eq!(checked, Ok(()), "{id:?} {value}");
            }
        }
    }
}
