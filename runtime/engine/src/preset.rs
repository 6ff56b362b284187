//! What the preset `auto` stands for: the largest point of the measured front that this device reaches in the time there is.
//!
//! Points are picture sizes, each with the Gaussians in view per pixel that the front was measured with ([`config::preset`]); a larger one
//! is better once each picture is visited often enough. What a step of each costs is forecast ([`tuning::cost`]).

use std::fmt;
use std::path::{Path, PathBuf};

use config::budget::Memory;
use config::plan::{Lanes, Plan, WORKING_SIDE};
use config::preset::{DENSITIES, SECONDS, SHOWN_BY, VISITS};
use config::training::{ResolutionSettings, ShSettings};
use job::run_json::RunReport;
use models::formats::{FormatError, read_bounded, write_atomic};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::device::DeviceRequest;
use tuning::loads::{Footprint, Visibility};
use tuning::model::CostModel;

mod flight;
mod memory;

pub use flight::{foresee, of_flight};
pub use memory::Room;

/// Fractions of a picture's size that are tried, smallest first: halves, at which JPEG files are decoded for less, and between.
pub const SCALES: [f64; 10] = [0.03125, 0.0625, 0.09375, 0.125, 0.1875, 0.25, 0.375, 0.5, 0.75, 1.0];
/// Pictures are not made smaller than this on the longer side: `tiny` has twice as much.
const LEAST_SIDE: u32 = 160;
/// Fewer Gaussians than this are no scene.
const LEAST_GAUSSIANS: f64 = 1000.0;
/// A size is not worth its pixels where the memory holds less than this share of the Gaussians that it needs at the least.
const LEAST_HELD: f64 = 0.5;
/// Where the choice is kept in the output folder.
pub const FILE: &str = "auto.json";
/// It has some 300 bytes.
const LIMIT: u64 = 16 << 10;

/// What is to be trained, and what was said about it.
#[derive(Clone, Debug)]
pub struct Wanted {
    /// Pictures as they come, pixels.
    pub picture: (u32, u32),
    /// Pictures are not trained larger than this on the longer side.
    pub most_side: u32,
    /// Pictures that are expected.
    pub views: usize,
    /// Share of the scene that one of them shows.
    pub share: f64,
    /// What the plan of the device is made of: views that there may be, and crops; its size, memory and Gaussians are chosen.
    pub device: DeviceRequest,
    /// `training.sh`.
    pub sh: ShSettings,
    /// `training.resolution`.
    pub resolution: ResolutionSettings,
    /// Steps of the schedule where nobody says how many.
    pub schedule: u32,
    /// Steps that were said.
    pub steps: Option<u32>,
    /// Seconds that were said.
    pub seconds: Option<f64>,
    /// Gaussians that were said.
    pub max_gaussians: Option<u32>,
    /// Scale that was said.
    pub image_scale: Option<f64>,
}

/// What kept the choice from being larger.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Limit {
    /// A larger one would leave too few visits.
    Time,
    /// A larger one does not fit.
    Memory,
    /// There is no larger one.
    Pictures,
}

/// The point, and what is expected of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// Most Gaussians.
    pub max_gaussians: u32,
    /// Pictures are trained at this fraction of their size.
    pub image_scale: f64,
    /// Pictures as they come.
    pub picture: (u32, u32),
    /// The one device allocation, MiB.
    pub device_mib: u32,
    /// Seconds of training, where nobody said any and the schedule takes longer than anybody would wait.
    pub seconds: Option<f64>,
    /// Forecast of a step, milliseconds.
    pub step_ms: f64,
    /// Forecast of the steps there will be.
    pub steps: u32,
    /// Pictures.
    pub views: usize,
    /// Why not more.
    pub limited_by: Limit,
}

/// One that could be chosen.
struct Point {
    scale: f64,
    gaussians: u32,
    plan: Plan,
    step_ms: f64,
    /// The plan holds fewer Gaussians than the point wants.
    is_cut: bool,
}

/// Share of a scene that each of so many pictures shows, where nothing tells.
pub fn shown(views: usize) -> f64 {
    (SHOWN_BY / views.max(1) as f64).min(1.0)
}

impl Wanted {
    /// The largest point with enough visits to each picture; the smallest where none has. `None` where no plan can be made.
    pub fn choose(&self, cost: &CostModel, room: &Room, lanes: Lanes) -> Option<Choice> {
        let views = self.views.max(1);
        let enough = u32::try_from(views).unwrap_or(u32::MAX).saturating_mul(VISITS);
        let needed = match (self.steps, self.seconds) {
            (Some(steps), None) => steps,
            (Some(steps), Some(_)) => steps.min(enough),
            _ => enough,
        };
        let there_is = self.seconds.unwrap_or(SECONDS);
        let in_time = |p: &Point| f64::from(needed) * p.step_ms <= 1e3 * there_is;
        let (mut chosen, mut larger, mut limit) = (None, None, Limit::Pictures);
        for scale in self.scales() {
            for density in DENSITIES {
                match self.point(scale, density, (cost, room, lanes)) {
                    Some(point) if chosen.is_none() || in_time(&point) => (chosen, larger) = (Some(point), None),
                    Some(_) => larger = larger.or(Some(Limit::Time)),
                    None => larger = larger.or(Some(Limit::Memory)),
                }
            }
        }
        let point = chosen?;
        if !in_time(&point) {
            limit = Limit::Time;
        } else if let Some(why) = larger {
            limit = why;
        } else if point.is_cut {
            limit = Limit::Memory;
        }
        let in_all = |s: f64| (1e3 * s / point.step_ms) as u32;
        let schedule = self.steps.unwrap_or(self.schedule);
        let cut_short = self.seconds.is_none() && self.steps.is_none() && schedule > in_all(SECONDS);
        let steps = match (self.seconds, self.steps) {
            (Some(seconds), None) => in_all(seconds),
            (Some(seconds), Some(steps)) => steps.min(in_all(seconds)),
            _ if cut_short => in_all(SECONDS),
            _ => schedule,
        };
        Some(Choice {
            max_gaussians: point.gaussians,
            image_scale: point.scale,
            picture: self.picture,
            device_mib: self.device_mib(&point, room, lanes),
            seconds: cut_short.then_some(SECONDS),
            step_ms: point.step_ms,
            steps: steps.max(1),
            views,
            limited_by: limit,
        })
    }

    fn size(&self, scale: f64) -> (u32, u32) {
        let side = |full: u32| ((f64::from(full) * scale).round() as u32).max(1);
        (side(self.picture.0), side(self.picture.1))
    }

    /// Scales to try, smallest first: the one that was said, or all whose pictures are neither too small nor too large.
    fn scales(&self) -> Vec<f64> {
        if let Some(said) = self.image_scale {
            return vec![said];
        }
        let longer = f64::from(self.picture.0.max(self.picture.1).max(1));
        // Where the largest that may be lies between two, it is one of them.
        let most = (f64::from(self.most_side) / longer).min(1.0);
        let least = f64::from(LEAST_SIDE) / longer;
        let between = |s: &f64| *s >= least && *s < 0.99 * most;
        SCALES.into_iter().filter(between).chain([most]).collect()
    }

    fn request(&self, scale: f64, gaussians: u32, device_mib: u32) -> DeviceRequest {
        let sizes = Memory { device_mib: Some(device_mib), max_gaussians: Some(gaussians), ..self.device.memory };
        DeviceRequest { size: self.size(scale), memory: sizes, ..self.device.clone() }
    }

    fn point(&self, scale: f64, density: f64, means: (&CostModel, &Room, Lanes)) -> Option<Point> {
        let (cost, room, lanes) = means;
        let (width, height) = self.size(scale);
        let pixels = u64::from(width) * u64::from(height);
        let share = if self.share > 0.0 { self.share.min(1.0) } else { 1.0 };
        let of = |density: f64| (density * pixels as f64 / share).max(LEAST_GAUSSIANS);
        let wanted = self.max_gaussians.unwrap_or_else(|| of(density).min(f64::from(u32::MAX >> 5)) as u32);
        let plan = Plan::new(&self.request(scale, wanted, room.device_mib).plan_request(&self.sh, lanes)).ok()?;
        let held = room.held(&plan, &self.sh).min(wanted);
        let is_cut = held < wanted;
        if is_cut && self.max_gaussians.is_none() && f64::from(held) < LEAST_HELD * of(DENSITIES[0]) {
            return None;
        }
        let step_ms = self.mean_ms((width, height), |divisor| {
            let pixels = pixels / u64::from(divisor * divisor);
            cost.step_ms(&Visibility { gaussians: held.into(), share, pixels }.load(Footprint::TRAINED))
        });
        // A number that was said stays, whatever the memory holds of it: the plan says so.
        let gaussians = self.max_gaussians.unwrap_or(held);
        Some(Point { scale, gaussians, plan, step_ms: step_ms.max(1e-3), is_cut })
    }

    /// Milliseconds of a step on the mean over a schedule in which pictures are small at first, from what one takes at each divisor of
    /// their size.
    fn mean_ms(&self, size: (u32, u32), at: impl Fn(u32) -> f64) -> f64 {
        let phases = self.resolution.phases(size.0, size.1).map(|(share, divisor)| (f64::from(share), at(divisor)));
        // The schedule goes by time, or by steps.
        if self.seconds.is_some() {
            phases.iter().map(|(share, ms)| share / ms).sum::<f64>().recip()
        } else {
            phases.iter().map(|(share, ms)| share * ms).sum()
        }
    }

    /// What the point needs, so that as many pictures stay on the device as with all there is.
    fn device_mib(&self, point: &Point, room: &Room, lanes: Lanes) -> u32 {
        let slots = point.plan.bytes("views");
        let needed = point.plan.total_bytes.max(2 * slots).div_ceil(1 << 20);
        let least = u32::try_from(needed).unwrap_or(u32::MAX).min(room.device_mib);
        let holds = |mib: u32| {
            let plan = Plan::new(&self.request(point.scale, point.gaussians, mib).plan_request(&self.sh, lanes));
            plan.is_ok_and(|p| p.gaussians >= point.plan.gaussians.min(point.gaussians as usize))
        };
        if !room.is_said && holds(least) { least } else { room.device_mib }
    }
}

impl Choice {
    /// The file below `out`.
    fn path(out: &Path) -> PathBuf {
        out.join(FILE)
    }

    /// What an earlier run in `out` chose, so that one that goes on keeps its plan; `None` where none did, or the file is no choice.
    pub fn kept(out: &Path) -> Option<Self> {
        let path = Self::path(out);
        if !path.exists() {
            return None;
        }
        let invalid = |what: String| FormatError::Invalid { path: path.clone(), what };
        let read = read_bounded(&path, LIMIT).and_then(|bytes| {
            serde_json::from_slice::<Self>(&bytes).map_err(|e| invalid(format!("not a choice of dgtr: {e}")))
        });
        match read {
            Ok(choice) if choice.is_sound() => Some(choice),
            Ok(_) => {
                tracing::warn!("{}", invalid("sizes that cannot be; they are chosen anew".into()));
                None
            }
            Err(e) => {
                tracing::warn!("{e}; sizes are chosen anew");
                None
            }
        }
    }

    /// Keeps it there.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn keep(&self, out: &Path) -> Result<(), FormatError> {
        let path = Self::path(out);
        std::fs::create_dir_all(out).map_err(|e| FormatError::io(out, "making the folder", e))?;
        write_atomic(&path, |file| {
            serde_json::to_writer_pretty(&mut *file, self)?;
            file.write_all(b"\n")
        })
    }

    fn is_sound(&self) -> bool {
        self.max_gaussians > 0
            && self.image_scale > 0.0
            && self.image_scale <= 1.0
            && (16..=131_072).contains(&self.device_mib)
            && self.seconds.is_none_or(|s| s > 0.0 && s.is_finite())
            && self.step_ms > 0.0
            && self.step_ms.is_finite()
    }

    /// Writes forecast and real milliseconds of a step into a finished job's figures.
    pub fn note(&self, report: &mut RunReport) {
        let measured = report.stage_ms.get("train").filter(|_| report.steps > 0).map(|ms| ms / report.steps as f64);
        let mut forecast = serde_json::to_value(self).unwrap_or_default();
        if let (Value::Object(fields), Some(ms)) = (&mut forecast, measured) {
            fields.insert("measured_ms".into(), ms.into());
        }
        report.more.insert("forecast".into(), forecast);
    }
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (width, height) = self.picture;
        let seconds = 1e-3 * self.step_ms * f64::from(self.steps);
        let limit = match self.limited_by {
            Limit::Time => "time",
            Limit::Memory => "memory",
            Limit::Pictures => "the pictures",
        };
        write!(
            f,
            "auto: {} Gaussians at {:.3} of {width}×{height} in {} MiB: {:.1} ms a step forecast, {} steps in {seconds:.0} s, \
             {:.0} visits a picture; limited by {limit}",
            self.max_gaussians,
            self.image_scale,
            self.device_mib,
            self.step_ms,
            self.steps,
            f64::from(self.steps) / self.views.max(1) as f64,
        )
    }
}

/// Pictures of a folder are trained as large as they come where somebody says how long, else at the size that the front was measured with.
pub fn most_side(picture: (u32, u32), seconds: Option<f64>) -> u32 {
    if seconds.is_some() { picture.0.max(picture.1) } else { WORKING_SIDE }
}

#[cfg(test)]
mod tests;
