//! What others ask of the autopilot: time, parameters (the faults, live), messages and their rates.

use super::{Autopilot, TEXTS};
use config::faults::FaultSettings;
use hal::error::HalError;
use hal::mavlink::dialect::{
    COMMAND_ACK_DATA, COMMAND_LONG_DATA, MavCmd, MavParamType, MavResult, PARAM_REQUEST_LIST_DATA,
    PARAM_REQUEST_READ_DATA, PARAM_SET_DATA, PARAM_VALUE_DATA, STATUSTEXT_DATA, TIMESYNC_DATA,
};
use hal::traits::Link;

/// A request, copied out of the frame that carried it.
enum Request {
    Time(TIMESYNC_DATA),
    SetParameter(PARAM_SET_DATA),
    ReadParameter(PARAM_REQUEST_READ_DATA),
    ListParameters,
    Command(COMMAND_LONG_DATA),
    Say(STATUSTEXT_DATA),
    Other,
}

impl<L: Link<Error = HalError>> Autopilot<L> {
    pub(super) fn answer(&mut self, now_s: &dyn Fn() -> f64) -> Result<(), HalError> {
        loop {
            let me = self.settings.system_id;
            let Some(frame) = self.channel.next_frame() else { return Ok(()) };
            let from = (frame.system(), frame.component());
            let mine = |target: u8| target == 0 || target == me;
            let request = if let Some(m) = frame.message::<TIMESYNC_DATA>() {
                if m.tc1 == 0 && mine(m.target_system) { Request::Time(m) } else { Request::Other }
            } else if let Some(m) = frame.message::<PARAM_SET_DATA>() {
                if mine(m.target_system) { Request::SetParameter(m) } else { Request::Other }
            } else if let Some(m) = frame.message::<PARAM_REQUEST_READ_DATA>() {
                if mine(m.target_system) { Request::ReadParameter(m) } else { Request::Other }
            } else if let Some(m) = frame.message::<PARAM_REQUEST_LIST_DATA>() {
                if mine(m.target_system) { Request::ListParameters } else { Request::Other }
            } else if let Some(m) = frame.message::<COMMAND_LONG_DATA>() {
                if mine(m.target_system) { Request::Command(m) } else { Request::Other }
            } else if let Some(m) = frame.message::<STATUSTEXT_DATA>() {
                Request::Say(m)
            } else {
                Request::Other
            };
            self.heard += 1;
            match request {
                Request::Time(m) => {
                    let tc1 = self.boot_us(now_s()) as i64 * 1000;
                    let (target_system, target_component) = from;
                    self.channel.send(&TIMESYNC_DATA { tc1, ts1: m.ts1, target_system, target_component })?;
                }
                Request::SetParameter(m) => {
                    if let Some(index) = m.param_id.to_str().ok().and_then(|name| self.faults.set(name, m.param_value))
                    {
                        self.say_parameter(index)?;
                    }
                }
                Request::ReadParameter(m) => {
                    let by_name = || {
                        let name = m.param_id.to_str().ok()?;
                        FaultSettings::PARAMETERS.iter().position(|p| p.name == name)
                    };
                    let index = if m.param_index >= 0 { Some(m.param_index as usize) } else { by_name() };
                    if let Some(index) = index {
                        self.say_parameter(index)?;
                    }
                }
                Request::ListParameters => self.list_from = Some(0),
                Request::Command(m) => self.command(&m, from, now_s())?,
                Request::Say(m) => {
                    if self.texts.len() >= TEXTS {
                        self.texts.pop_front();
                    }
                    self.texts.extend(m.text.to_str().map(str::to_owned));
                }
                Request::Other => {}
            }
        }
    }

    /// The next few parameters of a list that was asked for: a burst of all would overrun a slow line.
    pub(super) fn list_parameters(&mut self) -> Result<(), HalError> {
        for _ in 0..4 {
            let Some(index) = self.list_from else { break };
            self.say_parameter(index)?;
            self.list_from = (index + 1 < FaultSettings::PARAMETERS.len()).then_some(index + 1);
        }
        Ok(())
    }

    fn say_parameter(&mut self, index: usize) -> Result<(), HalError> {
        let (Some(value), Some(p)) = (self.faults.value(index), FaultSettings::PARAMETERS.get(index)) else {
            return Ok(());
        };
        self.channel.send(&PARAM_VALUE_DATA {
            param_value: value,
            param_count: FaultSettings::PARAMETERS.len() as u16,
            param_index: index as u16,
            param_id: p.name.into(),
            param_type: MavParamType::MAV_PARAM_TYPE_REAL32,
        })
    }

    fn command(&mut self, m: &COMMAND_LONG_DATA, from: (u8, u8), now_s: f64) -> Result<(), HalError> {
        let id = m.param1 as u32;
        let stream = self.streams.iter_mut().find(|s| s.id == id);
        let result = match (m.command, stream) {
            (MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, Some(stream)) => {
                // µs; −1 stops it, 0 is the default rate.
                let default = super::STREAMS.iter().find(|s| s.0 == id).map_or(0.0, |s| s.1);
                stream.period_s = match m.param2 {
                    us if us < 0.0 => None,
                    0.0 => (default > 0.0).then(|| 1.0 / default),
                    us => Some(f64::from(us).clamp(1e3, 3.6e9) * 1e-6),
                };
                stream.next_s = now_s;
                MavResult::MAV_RESULT_ACCEPTED
            }
            (MavCmd::MAV_CMD_REQUEST_MESSAGE, Some(stream)) => {
                let count = stream.count;
                stream.count += 1;
                self.say(id, count, now_s)?;
                MavResult::MAV_RESULT_ACCEPTED
            }
            (MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL | MavCmd::MAV_CMD_REQUEST_MESSAGE, None) => {
                MavResult::MAV_RESULT_DENIED
            }
            _ => MavResult::MAV_RESULT_UNSUPPORTED,
        };
        let (target_system, target_component) = from;
        self.channel.send(&COMMAND_ACK_DATA {
            command: m.command,
            result,
            target_system,
            target_component,
            ..Default::default()
        })
    }
}
