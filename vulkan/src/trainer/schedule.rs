//! How much of the schedule is over: its steps and seconds, where it begins, and what earlier processes spent on it.

use super::Trainer;

impl Trainer {
    /// Goes on with a schedule on which earlier processes spent `steps` and `seconds`; holds until the next
    /// [`Trainer::load`].
    pub fn continue_from(&mut self, steps: u32, seconds: f64) {
        self.before = (steps, seconds);
    }

    /// How long the schedule may take from now on, seconds; `None`: its steps alone decide. What is over is over: its share
    /// changes.
    pub fn set_seconds(&mut self, seconds: Option<f64>) {
        self.settings.seconds = seconds;
    }

    /// Puts the schedule to `progress`, 0…1, for what is there; moments stay.
    pub fn renew_schedule(&mut self, progress: f32) {
        let share = f64::from(progress.clamp(0.0, 1.0));
        let steps = (share * f64::from(self.settings.steps)) as u32;
        self.before = (steps, share * self.settings.seconds.unwrap_or(0.0));
        self.since = (self.looked, self.elapsed_s);
    }

    /// Until the next [`Trainer::load`] the schedule begins at `progress`, 0…1, and takes as long as it would from its beginning: what is
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
        let (looked, seconds) = (self.looked - self.since.0, self.elapsed_s - self.since.1);
        (self.before.0.saturating_add(looked as u32), self.before.1 + seconds)
    }

    /// Where in the schedule it is, 0…1.
    pub fn progress(&self) -> f32 {
        self.begun_at + (1.0 - self.begun_at) * self.spent_share()
    }

    /// The share of its steps or seconds that is spent.
    fn spent_share(&self) -> f32 {
        let (steps, seconds) = self.spent();
        self.settings.progress(steps, seconds)
    }

    /// How many steps the schedule takes, wherever it begins. With a budget in seconds that is what the pace so far promises.
    pub fn expected_steps(&self) -> u32 {
        let share = self.spent_share();
        match self.settings.seconds {
            Some(_) if share > 0.01 => (self.spent().0 as f32 / share) as u32,
            _ => self.settings.steps,
        }
    }

    /// Weight of view dependence: none where views are looked at too seldom to be learnt by heart.
    pub(super) fn view_dependence(&self) -> f32 {
        let loss = &self.settings.loss;
        let looks = u64::from(loss.view_dependence_visits) * self.views.len() as u64;
        if u64::from(self.expected_steps()) >= looks { loss.view_dependence } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use config::plan::{Plan, PlanRequest};

    use super::*;
    use crate::gpu::Gpu;
    use crate::synthetic::plain;

    fn trainer() -> Option<Trainer> {
        let Ok(gpu) = Gpu::open(None) else {
            println!("skipped: no Vulkan device");
            return None;
        };
        let request = PlanRequest { width: 48, height: 32, views: 1, max_gaussians: Some(10), ..Default::default() };
        Some(Trainer::new(&gpu, &Plan::new(&request).unwrap(), &plain()).unwrap())
    }

    #[test]
    fn a_schedule_takes_as_many_steps_wherever_it_begins() {
        let Some(mut t) = trainer() else { return };
        t.settings.steps = 100_000;
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
        let Some(mut t) = trainer() else { return };
        t.settings.steps = 7_000;
        t.set_seconds(Some(100.0));
        t.continue_from(50, 0.5);
        assert_eq!(t.expected_steps(), 7_000);
        t.set_seconds(None);
        t.continue_from(1_000, 90.0);
        assert_eq!(t.expected_steps(), 7_000);
    }
}
