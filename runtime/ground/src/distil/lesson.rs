//! What is to be learnt: the parts of an aircraft's views that show seams, as the aircraft's own model draws them.

use image::RgbImage;
use models::camera::{Intrinsics, PoseSigma, PosedImage, View};
use models::mask::Mask;
use models::metrics::{self, to_rgb8};
use vulkan::trainer::{Rendering, Trainer};

use crate::AggregateError;
use crate::plan::Recipe;
use crate::seam::Seams;

/// Of so many lessons from places nobody flew one is kept back from training: what a teacher shows there is further from a
/// photograph than what it shows of its own views (sheffield_cross 25.88 dB, 25.82 where every fourth of all was kept back).
const KEEP_BACK_UNFLOWN: usize = 2;
/// And of all lessons, where none is from such a place.
const KEEP_BACK: usize = 4;
/// Lessons of one job, at most: where more views see its seams, every so-many-th is taken.
const MOST_LESSONS: usize = 512;
/// A model vouches for what it shows where less than this much light passes through it.
const CLEAR: f32 = 0.3;
/// A pixel that shows no seam.
const NO_CELL: u16 = u16::MAX;

/// The part of a view that shows seams, with the picture its teacher drew.
pub struct Lesson {
    /// Index of the model whose view it is.
    pub model: usize,
    pub name: String,
    pub view: View,
    /// Share of the Gaussians in the whole view that lie in a seam.
    pub share: f64,
    /// Asked at the end only.
    pub is_kept_back: bool,
    /// 8 bits: what the trainer keeps of a picture anyway.
    pub target: RgbImage,
    /// Cell that each pixel shows.
    cells: Vec<u16>,
}

/// The lessons, without their pictures yet, and the number of views there are; `views` are those of each model.
pub fn choose(views: &[Vec<(String, View)>], seams: &Seams, recipe: &Recipe) -> (Vec<Lesson>, usize) {
    let (mut lessons, mut count) = (Vec::new(), 0);
    for (model, views) in views.iter().enumerate() {
        let between = if recipe.between_views { between(views) } else { Vec::new() };
        let flown = views.iter().map(|v| (v, true));
        for ((name, view), is_flown) in flown.chain(between.iter().map(|v| (v, false))) {
            count += 1;
            let share = seams.seen_by(view);
            let view = View { intrinsics: scaled(&view.intrinsics, recipe.scale), pose: view.pose };
            let window = if share >= f64::from(recipe.seam_share) { seams.window(&view) } else { None };
            if let Some(window) = window {
                let (name, view) = (name.clone(), part(&view, window));
                let is_kept_back = !is_flown;
                let (target, cells) = (RgbImage::new(0, 0), Vec::new());
                lessons.push(Lesson { model, name, view, share, is_kept_back, target, cells });
            }
        }
    }
    let (every, mut seen) = (lessons.len().div_ceil(MOST_LESSONS).max(1), 0);
    lessons.retain(|_| {
        seen += 1;
        (seen - 1) % every == 0
    });
    keep_back(&mut lessons, views.len());
    (lessons, count)
}

/// Chooses which of the lessons that may be kept back are, or, where none may, of all.
fn keep_back(lessons: &mut [Lesson], models: usize) {
    let unflown = lessons.iter().any(|l| l.is_kept_back);
    let every = if unflown { KEEP_BACK_UNFLOWN } else { KEEP_BACK };
    let mut of_model = vec![0usize; models];
    for lesson in lessons.iter_mut().filter(|l| l.is_kept_back || !unflown) {
        let n = &mut of_model[lesson.model];
        lesson.is_kept_back = n.is_multiple_of(every);
        *n += 1;
    }
}

/// A view half-way from each view to its nearest neighbour, turned like the view itself; each pair once.
fn between(views: &[(String, View)]) -> Vec<(String, View)> {
    let mut made: Vec<(usize, usize)> = Vec::new();
    for (i, (_, view)) in views.iter().enumerate() {
        let apart = |j: &usize| views[*j].1.pose.center.distance(view.pose.center);
        let nearest = (0..views.len()).filter(|&j| j != i).min_by(|a, b| apart(a).total_cmp(&apart(b)));
        if let Some(j) = nearest
            && !made.contains(&(j, i))
        {
            made.push((i, j));
        }
    }
    let half_way = |(i, j): (usize, usize)| {
        let (a, b) = (&views[i], &views[j]);
        let mut view = a.1;
        view.pose.center = 0.5 * (a.1.pose.center + b.1.pose.center);
        (format!("{} – {}", a.0, b.0), view)
    };
    made.into_iter().map(half_way).collect()
}

fn scaled(k: &Intrinsics, scale: f32) -> Intrinsics {
    let side = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    k.resized(side(k.width), side(k.height))
}

fn part(view: &View, [left, top, right, bottom]: [u32; 4]) -> View {
    let k = view.intrinsics;
    let (width, height) = (right - left, bottom - top);
    let lens = Intrinsics { width, height, cx: k.cx - left as f32, cy: k.cy - top as f32, ..k };
    View { intrinsics: lens, pose: view.pose }
}

impl Lesson {
    /// Has the teacher on `trainer` draw the picture and say which pixels show which cell.
    pub fn ask(&mut self, trainer: &mut Trainer, seams: &Seams) -> Result<(), AggregateError> {
        let mut drawn = Rendering::default();
        self.target = draw(trainer, &self.view, &mut drawn)?;
        let k = &self.view.intrinsics;
        let shows = |i: usize| {
            let opaque = 1.0 - drawn.transmittance[i];
            if opaque < 1.0 - CLEAR {
                return NO_CELL;
            }
            let (x, y) = ((i as u32 % k.width) as f32 + 0.5, (i as u32 / k.width) as f32 + 0.5);
            // Blended depth is weighted by opacity; the surface lies at the mean.
            let depth = drawn.depth[i] / opaque;
            let p = glam::Vec3::new((x - k.cx) / k.fx * depth, (y - k.cy) / k.fy * depth, depth).as_dvec3();
            let p = self.view.pose.rotation * p + self.view.pose.center;
            seams.index_of(&p.as_vec3().to_array()).unwrap_or(NO_CELL)
        };
        self.cells = (0..drawn.transmittance.len()).map(shows).collect();
        Ok(())
    }

    /// Whether any pixel shows a seam.
    pub fn is_worth_it(&self) -> bool {
        self.cells.iter().any(|c| *c != NO_CELL)
    }

    /// As the trainer takes it: only pixels that show seams count.
    pub fn picture(&self) -> PosedImage {
        let shows = |x: u32, y: u32| self.cells[(y * self.target.width() + x) as usize] != NO_CELL;
        PosedImage {
            name: self.name.clone(),
            time_ns: 0,
            image: self.target.clone(),
            view: self.view,
            mask: Some(Mask::from_fn(self.target.width(), self.target.height(), shows)),
            sigma: PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] },
        }
    }

    /// What a picture of this view is off the teacher's, cell by cell.
    pub fn errors(&self, shown: &RgbImage, into: &mut Errors) {
        for ((cell, a), b) in self.cells.iter().zip(shown.pixels()).zip(self.target.pixels()) {
            if let Some(of_cell) = into.0.get_mut(usize::from(*cell)) {
                of_cell[0] += (0..3).map(|c| (f64::from(a.0[c]) - f64::from(b.0[c])).powi(2)).sum::<f64>();
                of_cell[1] += 3.0;
            }
        }
    }
}

/// Squared differences of 8-bit values and their number, per cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Errors(pub Vec<[f64; 2]>);

impl Errors {
    /// Of nothing yet.
    pub fn none(cells: usize) -> Self {
        Self(vec![[0.0; 2]; cells])
    }

    /// Of all cells.
    pub fn sum(&self) -> [f64; 2] {
        self.0.iter().fold([0.0; 2], |[s, n], of_cell| [s + of_cell[0], n + of_cell[1]])
    }
}

/// PSNR of squared differences of 8-bit values and their number, dB; None without a value. Equal pictures are as close as 8 bits can tell.
pub fn psnr_of([sum, n]: [f64; 2]) -> Option<f64> {
    (n > 0.0).then(|| (10.0 * (255.0 * 255.0 * n / sum.max(f64::MIN_POSITIVE)).log10()).min(60.0))
}

/// Draws what a trainer holds.
pub fn draw(trainer: &mut Trainer, view: &View, into: &mut Rendering) -> Result<RgbImage, AggregateError> {
    trainer.render(view, into)?;
    // The renderer fills exactly the size it was asked for.
    Ok(to_rgb8(&into.rgb, into.width, into.height).unwrap_or_default())
}

/// PSNR of two pictures, dB.
pub fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
    metrics::psnr(&metrics::to_f32(a), &metrics::to_f32(b)).min(60.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::nadir;

    fn lesson(model: usize, is_flown: bool) -> Lesson {
        let (name, target, cells) = (String::new(), RgbImage::new(0, 0), Vec::new());
        Lesson { model, name, view: nadir(0.0, 0.0, 30.0), share: 1.0, is_kept_back: !is_flown, target, cells }
    }

    #[test]
    fn what_is_kept_back_was_never_photographed_unless_everything_was() {
        let kept = |flown: &[(usize, bool)]| {
            let mut lessons: Vec<Lesson> = flown.iter().map(|&(m, f)| lesson(m, f)).collect();
            keep_back(&mut lessons, 2);
            (0..lessons.len()).filter(|&i| lessons[i].is_kept_back).collect::<Vec<_>>()
        };
        let mixed = [(0, true), (0, false), (0, true), (0, false), (0, false), (1, true), (1, true), (1, false)];
        assert_eq!(kept(&mixed), [1, 4, 7], "the first and every second of each model");
        assert_eq!(kept(&[(0, true); 6]), [0, 4]);
    }
}
