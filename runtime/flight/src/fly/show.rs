//! The flight on the live page, as its aircraft 0: capture tells where the aircraft is and what it photographs, the job what it
//! makes of it. Both write into a state of fixed size.

use hal::autopilot::AutopilotState;
use hal::failsafe::State;
use hal::vehicle::Complaint;
use image::RgbImage;
use models::camera::{Intrinsics, Pose, View};
use pages::report::ground::Shot;
use pages::watch::Watch;
use survey::coverage::CoverageMap;
use vulkan::trainer::StepReport;

use crate::coverage::Coverage;

/// Between two looks at the squares of ground: some milliseconds each on a small board.
const SURVEY_EVERY_NS: u64 = 2_000_000_000;
/// Before this share of the schedule its pace says little about what is left.
const PACE_FROM: f64 = 0.01;

/// What capture tells.
pub(super) struct ShownCapture {
    watch: Watch,
    lens: Intrinsics,
    /// Where the aircraft was last, metres east, north, up.
    pub(super) at: Option<[f64; 3]>,
    /// How much of the region was covered when that was last looked at, percent.
    pub(super) covered: Option<u32>,
    surveyed_ns: Option<u64>,
    /// What keeps pictures from being posed.
    complaints: Vec<Complaint>,
}

impl ShownCapture {
    /// Pictures of `lens`, those taken by earlier runs first.
    pub(super) fn new(watch: Watch, lens: Intrinsics, earlier: &[Pose]) -> Self {
        watch.update(|page| {
            let views = earlier.iter().map(|&pose| View { intrinsics: lens, pose });
            views.for_each(|view| page.ground.add(Shot::of(0, &view, 0.0)));
        });
        Self { watch, lens, at: None, covered: None, surveyed_ns: None, complaints: Vec::new() }
    }

    /// The aircraft as it is now.
    pub(super) fn aircraft(&self, autopilot: &AutopilotState, is_link_lost: bool, pictures: u64) {
        let complaint = self.complaints.first().copied();
        self.watch.craft(0, |craft| {
            craft.link = match (autopilot.heartbeat_ns, is_link_lost, complaint) {
                (Some(_), true, _) => "lost",
                (_, _, Some(complaint)) => complaint.name(),
                (None, ..) => "nothing heard yet",
                (Some(_), false, None) if autopilot.armed => "heard, armed",
                (Some(_), false, None) => "heard, disarmed",
            };
            (craft.at, craft.battery, craft.pictures) = (self.at, autopilot.battery_percent, Some(pictures));
        });
    }

    /// Something keeps pictures from being posed, or no longer does.
    pub(super) fn complain(&mut self, what: Complaint, stands: bool) {
        self.complaints.retain(|c| *c != what);
        self.complaints.extend(stands.then_some(what));
    }

    /// Nothing more is expected of link and camera.
    pub(super) fn over(&self) {
        self.watch.craft(0, |craft| craft.link = "the flight is over");
    }

    /// A key frame, and now and then what all of them cover.
    pub(super) fn key_frame(&mut self, pose: Pose, image: &RgbImage, map: Option<&CoverageMap>, now_ns: u64) {
        let is_due = self.surveyed_ns.is_none_or(|at| now_ns.saturating_sub(at) >= SURVEY_EVERY_NS);
        let due = map.filter(|_| is_due);
        self.surveyed_ns = due.map(|_| now_ns).or(self.surveyed_ns);
        let shot = Shot::of(0, &View { intrinsics: self.lens, pose }, map.map_or(0.0, CoverageMap::base_m));
        self.watch.update(|page| {
            page.ground.add(shot);
            self.covered = due.map(|map| (100.0 * page.ground.survey(0, map)) as u32).or(self.covered);
            if let Some(craft) = page.aircraft.first_mut() {
                craft.thumbnail.take(image);
                craft.covered = self.covered.or(craft.covered);
            }
        });
    }

    /// What all of them cover, at the end.
    pub(super) fn coverage(&self, coverage: &Coverage) {
        self.watch.update(|page| {
            page.ground.survey(0, &coverage.map);
            page.aircraft.iter_mut().take(1).for_each(|craft| craft.covered = Some(coverage.percent()));
        });
    }
}

/// What the job tells.
#[derive(Default)]
pub(super) struct ShownJob {
    watch: Watch,
    /// Steps of all schedules.
    steps: u64,
}

impl ShownJob {
    pub(super) fn new(watch: Watch) -> Self {
        Self { watch, steps: 0 }
    }

    /// What it does now.
    pub(super) fn state(&self, state: &'static str, key_frames: usize, gaussians: usize) {
        self.watch.craft(0, |craft| {
            craft.state = state;
            (craft.key_frames, craft.gaussians) = (Some(key_frames as u64), Some(gaussians as u64));
        });
    }

    /// A training step: allocates nothing.
    pub(super) fn step(&mut self, report: &StepReport) {
        self.steps += 1;
        let (steps, done) = (self.steps, f64::from(report.progress));
        self.watch.craft(0, |craft| {
            (craft.schedule.steps, craft.gaussians) = (Some(steps), Some(report.gaussians as u64));
            craft.schedule.progress = Some(report.progress);
            craft.schedule.left_s = (done >= PACE_FROM).then(|| report.elapsed_s * (1.0 - done) / done);
            craft.plot.curve.push(steps as f64, report.loss.into());
        });
    }

    /// Where the failsafe ladder stands.
    pub(super) fn rung(&self, state: &State) {
        let trouble = state.cause().map(|cause| (state.action().name(), cause.name()));
        self.watch.craft(0, |craft| craft.trouble = trouble);
    }

    /// Bytes that went to the ground.
    pub(super) fn sent(&self, bytes: u64) {
        self.watch.craft(0, |craft| craft.bytes = Some(bytes));
    }
}
