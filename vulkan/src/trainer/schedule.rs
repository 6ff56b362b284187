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
        self.since = (self.steps, self.elapsed_s);
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
        let (steps, seconds) = (self.steps - self.since.0, self.elapsed_s - self.since.1);
        (self.before.0.saturating_add(steps), self.before.1 + seconds)
    }

    /// Where in the schedule it is, 0…1.
    pub fn progress(&self) -> f32 {
        self.begun_at + (1.0 - self.begun_at) * self.spent_share()
    }

    /// The share of its steps or seconds that is spent.
    pub(super) fn spent_share(&self) -> f32 {
        let (steps, seconds) = self.spent();
        self.settings.progress(steps, seconds)
    }
}
