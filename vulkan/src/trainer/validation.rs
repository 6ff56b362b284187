//! Validation while a schedule runs: some views are kept back, and their loss is followed beside that of as many others as it falls. Where
//! it rises meanwhile, pictures are learnt by heart, and Gaussians are left out of each step from then on (DropGaussian, CVPR 2025), more
//! and more of them.

use config::training::ValidationSettings;

use super::step::Visit;
use super::{PictureStore, TrainError, Trainer};
use crate::device::Gradients;
use crate::layout::FLAG_DEPTH;
use crate::pictures::Picture;
use crate::pictures::sampler::Sampler;

/// Progress at which views are kept back: by then the pace says how often each will be visited, and what was learnt of them so far is
/// soon forgotten.
const FROM: f32 = 0.1;
/// Progress from which losses are compared, and until which.
const COMPARED: [f32; 2] = [0.15, 0.35];
/// Times each other view is visited between two comparisons.
const BETWEEN: f64 = 2.0;
/// Comparisons that say something.
const FEWEST: u32 = 5;
/// Fewer views than this are all needed.
const FEWEST_VIEWS: usize = 8;
/// Views kept back: at least and at most.
const KEPT: [usize; 2] = [2, 16];
/// Where the loss of the views kept back rises by this share of what the others' falls by (logarithms of both), the most is left out. Two
/// forests have -0.11 and 0.29, a room of 15 pictures 0.02 to 0.05 and of 43 0.51, and only the first of them gains by leaving much out
/// (measured at 59f7a9a).
const HARM: f64 = 0.1;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Phase {
    /// All views are trained.
    #[default]
    Before,
    KeptBack,
    Over,
}

/// What validation found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Validated {
    /// Views that were kept back.
    pub views: usize,
    /// Share of what is learnt of the training views that holds for them: how much the logarithm of their loss falls while that of the
    /// others' falls by 1.
    pub holds: f64,
    /// DropGaussian's γ from then on.
    pub drop: f32,
}

/// Kept-back views and what is known of them.
#[derive(Debug, Default)]
pub(crate) struct Validation {
    phase: Phase,
    views: Vec<u32>,
    /// Pictures visited when losses were compared last.
    compared: f64,
    /// Resolution of the losses compared: those of small pictures say nothing about those of larger ones.
    divisor: u32,
    falls: Falls,
    found: Option<Validated>,
}

impl Validation {
    pub fn new(views: usize) -> Self {
        Self { views: Vec::with_capacity(KEPT[1].min(views)), ..Self::default() }
    }

    pub fn reset(&mut self) {
        self.views.clear();
        (self.phase, self.compared, self.falls, self.found) = (Phase::Before, 0.0, Falls::default(), None);
    }

    /// DropGaussian's γ that it asks for.
    pub fn drop(&self) -> f32 {
        self.found.map_or(0.0, |found| found.drop)
    }

    /// Every so many of `views`, the first of them half as far from the beginning.
    fn choose(&mut self, views: usize, share: f32) {
        let wanted = ((views as f32 * share) as usize).clamp(KEPT[0], KEPT[1]);
        self.views.clear();
        self.views.extend((0..wanted).map(|k| ((2 * k + 1) * views / (2 * wanted)) as u32));
    }

    /// Keeps views back.
    fn keep_back(&mut self, views: usize, share: f32, sampler: &mut Sampler) {
        self.choose(views, share);
        self.phase = Phase::KeptBack;
        sampler.leave_out(|view| self.views.contains(&(view as u32)));
    }

    /// Gives the views back, and draws the conclusion.
    fn end(&mut self, settings: &ValidationSettings, sampler: &mut Sampler) {
        sampler.leave_out(|_| false);
        self.phase = Phase::Over;
        let views = self.views.len();
        let validated = |holds| Validated { views, holds, drop: drop_for(holds, settings) };
        self.found = self.falls.slope().map(validated);
    }
}

/// Least squares of the one loss against the other, by their logarithms.
#[derive(Clone, Copy, Debug, Default)]
struct Falls {
    n: u32,
    kept: f64,
    trained: f64,
    product: f64,
    square: f64,
}

impl Falls {
    fn add(&mut self, kept: f64, trained: f64) {
        let (y, x) = (kept.ln(), trained.ln());
        if !(x.is_finite() && y.is_finite()) {
            return;
        }
        self.n += 1;
        self.kept += y;
        self.trained += x;
        self.product += x * y;
        self.square += x * x;
    }

    /// How much the one falls as the other falls by 1; `None` where too little is known.
    fn slope(&self) -> Option<f64> {
        let n = f64::from(self.n);
        let (spread, common) =
            (self.square - self.trained * self.trained / n, self.product - self.trained * self.kept / n);
        (self.n >= FEWEST && spread > 1e-6 * n).then(|| common / spread)
    }
}

/// DropGaussian's γ where `holds` of what is learnt holds.
fn drop_for(holds: f64, s: &ValidationSettings) -> f32 {
    s.drop * (-holds / HARM).clamp(0.0, 1.0) as f32
}

impl Trainer {
    /// What validation found since the last [`Trainer::load`]; `None` where no view was kept back, or not for long enough.
    pub fn validated(&self) -> Option<Validated> {
        self.validation.found
    }

    /// Goes on with what validation found before, where a scene is loaded again in the midst of its schedule.
    pub fn continue_validated(&mut self, found: Option<Validated>) {
        (self.validation.phase, self.validation.found) = (Phase::Over, found);
    }

    /// Keeps views back, compares their loss with the others', or gives them back, as the schedule is at `progress`.
    pub(super) fn validate(&mut self, pictures: &mut PictureStore, progress: f32) -> Result<(), TrainError> {
        let views = pictures.len();
        match self.validation.phase {
            Phase::Before if progress >= FROM => {
                let s = &self.settings;
                let asked = s.validation.share > 0.0 && s.validation.drop > 0.0 && s.regularise.drop == 0.0;
                let early = progress < COMPARED[0];
                // What crops teach is no whole picture's loss.
                let crops = pictures.crops() > 0 && s.crops.from < COMPARED[1];
                let worth_it = views >= FEWEST_VIEWS && self.schedule.visits_each(views, s.validation.visits);
                let whole = !(crops || self.model.scene.is_paged() || self.turns.views.prefers_newest());
                self.validation.phase = Phase::Over;
                if asked && early && worth_it && whole {
                    self.validation.keep_back(views, s.validation.share, &mut self.turns.views);
                }
            }
            Phase::KeptBack if progress >= COMPARED[1] => {
                self.validation.end(&self.settings.validation, &mut self.turns.views);
            }
            Phase::KeptBack if progress >= COMPARED[0] => self.compare(pictures, progress)?,
            Phase::Before | Phase::KeptBack | Phase::Over => {}
        }
        Ok(())
    }

    fn compare(&mut self, pictures: &mut PictureStore, progress: f32) -> Result<(), TrainError> {
        let (views, visited) = (pictures.len(), self.schedule.visited);
        if visited < self.validation.compared + BETWEEN * views as f64 {
            return Ok(());
        }
        self.validation.compared = visited;
        let mut sums = [0.0; 2];
        for k in 0..self.validation.views.len() {
            let kept = self.validation.views[k] as usize;
            // Its neighbour in the order of capture sees what it sees.
            for (sum, view) in sums.iter_mut().zip([kept, (kept + 1) % views]) {
                let (loss, divisor) = self.loss_of(pictures, view, progress)?;
                *sum += f64::from(loss);
                if std::mem::replace(&mut self.validation.divisor, divisor) != divisor {
                    self.validation.falls = Falls::default();
                }
            }
        }
        self.validation.falls.add(sums[0], sums[1]);
        Ok(())
    }

    /// Loss of a view as it would be visited, but for its depth, and by how much its picture was reduced. Nothing learns from it.
    fn loss_of(&mut self, pictures: &mut PictureStore, index: usize, progress: f32) -> Result<(f32, u32), TrainError> {
        self.model.flush(&mut self.device)?;
        let picture = Picture::View(index);
        let framed = self.frame(pictures, Visit::whole(picture, progress));
        let frame = &mut self.device.frame;
        (frame.background, frame.drop_share) = ([0.0; 3], 0.0);
        frame.flags &= !FLAG_DEPTH;
        self.device.write_frame();
        self.project(pictures, picture, framed)?;
        let by = Gradients { exposure: self.settings.refine_exposure, ..Gradients::default() };
        self.device.compare(by)?;
        Ok((self.device.weigh(&self.device.partial_sums(by), &self.settings.loss).loss, framed.divisor))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_views_kept_back_are_spread_over_all_and_bounded() {
        let mut v = Validation::new(1000);
        for (views, share, expected) in
            [(8, 0.1, vec![2, 6]), (43, 0.1, vec![5, 16, 26, 37]), (20, 0.5, vec![1, 3, 5, 7, 9, 11, 13, 15, 17, 19])]
        {
            v.choose(views, share);
            assert_eq!(v.views, expected, "{views} {share}");
        }
        v.choose(1000, 0.1);
        assert_eq!((v.views.len(), v.views[0], v.views[15]), (16, 31, 968));
    }

    #[test]
    fn what_holds_is_how_far_the_one_loss_falls_with_the_other_however_they_jitter() {
        for holds in [-0.3, 0.0, 0.4, 1.0] {
            let mut falls = Falls::default();
            for k in 0..10 {
                let x = -0.1 * f64::from(k) + 0.01 * f64::from(k * 7 % 5);
                let y = holds * x + 0.001 * f64::from(k * 3 % 4);
                assert!(falls.slope().is_none() || k >= 5);
                falls.add(y.exp(), x.exp());
            }
            let slope = falls.slope().unwrap();
            assert!((slope - holds).abs() < 0.02, "{slope} for {holds}");
        }
        let mut still = Falls::default();
        (0..10).for_each(|_| still.add(0.1, 0.1));
        still.add(f64::NAN, 0.1);
        still.add(0.1, 0.0);
        assert_eq!((still.slope(), still.n), (None, 10), "what does not fall says nothing, nor what is no number");
    }

    #[test]
    fn the_worse_what_is_learnt_makes_other_views_the_more_is_left_out() {
        let s = ValidationSettings::default();
        let drops = [-0.5, -HARM, -0.5 * HARM, 0.0, 0.7].map(|holds| drop_for(holds, &s));
        assert_eq!(drops, [s.drop, s.drop, 0.5 * s.drop, 0.0, 0.0]);
    }
}
