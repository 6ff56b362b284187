//! How much of the schedule is over: its steps and seconds, where it begins, and what earlier processes spent on it. Nothing but numbers.

use config::training::{TrainSettings, share_spent};

/// A schedule and what is spent of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Steps that it takes at most.
    steps: u32,
    /// Seconds that it takes at most.
    seconds: Option<f64>,
    /// Pictures visited since the Gaussians were loaded, parts of them by their share of its pixels.
    pub(crate) visited: f64,
    /// Seconds of training since then.
    elapsed_s: f64,
    /// Steps and seconds that earlier processes spent on the same schedule.
    before: (u32, f64),
    /// Pictures visited and seconds spent when it began anew.
    since: (f64, f64),
    /// Progress at which it begins.
    begun_at: f32,
}

impl Schedule {
    pub(crate) fn new(settings: &TrainSettings) -> Self {
        Self {
            steps: settings.steps,
            seconds: settings.seconds,
            visited: 0.0,
            elapsed_s: 0.0,
            before: (0, 0.0),
            since: (0.0, 0.0),
            begun_at: 0.0,
        }
    }

    /// Begins with nothing spent.
    pub(crate) fn restart(&mut self) {
        (self.visited, self.elapsed_s) = (0.0, 0.0);
        (self.before, self.since, self.begun_at) = ((0, 0.0), (0.0, 0.0), 0.0);
    }

    /// Takes so many steps from now on.
    pub(crate) fn set_steps(&mut self, steps: u32) {
        self.steps = steps;
    }

    /// Spends a share of a picture, and seconds.
    pub(crate) fn spend(&mut self, share: f64, seconds: f64) {
        self.visited += share;
        self.elapsed_s += seconds;
    }

    /// Steps taken since the Gaussians were loaded: pictures visited. Where a scene is larger than the device a picture is visited in
    /// parts, each of which updates the Gaussians, and its step is over when they amount to it.
    pub fn taken(&self) -> u32 {
        self.visited as u32
    }

    /// Number of the present update, by which Adam corrects the bias of its moments. Gaussians are updated as often in so many steps
    /// whether pictures are visited whole or in parts.
    pub(crate) fn adam_step(&self) -> u32 {
        self.taken() + 1
    }

    /// What Adam multiplies second moments by, which begin at zero.
    pub(crate) fn second_unbias(&self, beta2: f32) -> f32 {
        let steps = self.taken().max(1) as i32;
        (1.0 / (1.0 - f64::from(beta2).powi(steps))) as f32
    }

    /// Seconds of training since the Gaussians were loaded.
    pub fn elapsed_s(&self) -> f64 {
        self.elapsed_s
    }

    /// Goes on with a schedule on which earlier processes spent `steps` and `seconds`; holds until the next load.
    pub fn continue_from(&mut self, steps: u32, seconds: f64) {
        self.before = (steps, seconds);
    }

    /// How long the schedule may take from now on, seconds; `None`: its steps alone decide. What is over is over: its share
    /// changes.
    pub fn set_seconds(&mut self, seconds: Option<f64>) {
        self.seconds = seconds;
    }

    /// Puts the schedule to `progress`, 0…1, for what is there; moments stay.
    pub fn renew(&mut self, progress: f32) {
        let share = f64::from(progress.clamp(0.0, 1.0));
        let steps = (share * f64::from(self.steps)) as u32;
        self.before = (steps, share * self.seconds.unwrap_or(0.0));
        self.since = (self.visited, self.elapsed_s);
    }

    /// Until the next load the schedule begins at `progress`, 0…1, and takes as long as it would from its beginning: what is
    /// trained already needs no large rates and no small pictures.
    pub fn begin_at(&mut self, progress: f32) {
        self.begun_at = progress.clamp(0.0, 1.0);
    }

    /// Progress at which the schedule begins.
    pub fn begun_at(&self) -> f32 {
        self.begun_at
    }

    /// Steps and seconds spent on the schedule, earlier processes' included.
    pub fn spent(&self) -> (u32, f64) {
        let (visited, seconds) = (self.visited - self.since.0, self.elapsed_s - self.since.1);
        (self.before.0.saturating_add(visited as u32), self.before.1 + seconds)
    }

    /// Where in the schedule it is, 0…1.
    pub fn progress(&self) -> f32 {
        self.begun_at + (1.0 - self.begun_at) * self.spent_share()
    }

    /// The share of its steps or seconds that is spent.
    fn spent_share(&self) -> f32 {
        share_spent((self.steps, self.seconds), self.spent())
    }

    /// How many steps the schedule takes, wherever it begins. With a budget in seconds that is what the pace so far promises.
    pub fn expected_steps(&self) -> u32 {
        let share = self.spent_share();
        match self.seconds {
            Some(_) if share > 0.01 => (self.spent().0 as f32 / share) as u32,
            _ => self.steps,
        }
    }

    /// Whether each of `views` is visited so often in it.
    pub(crate) fn visits_each(&self, views: usize, visits: u32) -> bool {
        u64::from(self.expected_steps()) >= u64::from(visits) * views as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(steps: u32) -> Schedule {
        Schedule::new(&TrainSettings { steps, ..TrainSettings::default() })
    }

    #[test]
    fn a_schedule_takes_as_many_steps_wherever_it_begins() {
        let mut t = of(100_000);
        // A tenth of the seconds for a thousand steps.
        t.set_seconds(Some(100.0));
        t.continue_from(1_000, 10.0);
        for begun_at in [0.0, 0.5] {
            t.begin_at(begun_at);
            assert!((t.progress() - (begun_at + (1.0 - begun_at) * 0.1)).abs() < 1e-6);
            assert!(t.expected_steps().abs_diff(10_000) <= 1, "{}", t.expected_steps());
        }
    }

    #[test]
    fn before_a_pace_is_known_and_without_seconds_the_schedule_takes_its_steps() {
        let mut t = of(7_000);
        t.set_seconds(Some(100.0));
        t.continue_from(50, 0.5);
        assert_eq!(t.expected_steps(), 7_000);
        t.set_seconds(None);
        t.continue_from(1_000, 90.0);
        assert_eq!(t.expected_steps(), 7_000);
    }
}
