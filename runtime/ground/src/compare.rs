//! Local and global models against held-out photographs, where the ground has them (after landing, in tests, in the
//! demo): the global model should not be worse than a local one on that one's own ground.

use std::path::{Path, PathBuf};

use image::RgbImage;
use models::camera::View;
use models::formats::model;
use models::metrics::to_rgb8;
use survey::dataset::{Dataset, picture_names};
use vulkan::trainer::{Rendering, Trainer};

use super::region::Region;

use engine::device::renderer;
use engine::error::EngineError;
use engine::evaluate::{IntoModel, Perceptual, Scores, evaluate, open_metric};
use pages::report::{Comparison, ReportData};

/// A global model this much worse than a local one on its own ground is worth a warning, dB.
const WORTH_A_WARNING_DB: f64 = 0.3;

/// Pictures taken no farther from another aircraft's region show its ground, metres.
const NEAR_BORDER_M: f64 = 10.0;

/// One aircraft's held-out pictures: its own model's figures and the global one's on the same pictures.
#[derive(Clone, Debug)]
pub struct Held {
    /// Name of the aircraft.
    pub name: String,
    /// Its own model.
    pub local: Scores,
    /// The global model on the same pictures.
    pub global: Scores,
    /// Of those taken near another aircraft's region: how many, and the mean PSNR of the own and of the global model, dB.
    pub near_border: Option<(usize, [f64; 2])>,
    /// One picture: photograph, local, global.
    pub pictures: Option<(String, [RgbImage; 3])>,
}

struct Opened {
    trainer: Trainer,
    into: IntoModel,
}

impl Opened {
    fn new(path: &Path, set: &Dataset, size: (u32, u32), device: Option<&str>) -> Result<Self, EngineError> {
        let (header, cloud) = model::read(path)?;
        let trainer = renderer(device, &cloud, size.0, size.1)?;
        Ok(Self { trainer, into: IntoModel::of(set, &header) })
    }

    fn picture(&mut self, view: &View) -> Result<RgbImage, EngineError> {
        let mut into = Rendering::default();
        let view = View { intrinsics: view.intrinsics, pose: self.into.transfer.apply(&view.pose) };
        self.trainer.render(&view, &mut into)?;
        Ok(to_rgb8(&into.rgb, into.width, into.height).unwrap_or_default())
    }
}

/// Measures all models on the pictures of `split`; a picture counts for the model with the nearest training view.
/// `locals` are names and files, `metric` the manifest of a perceptual metric.
///
/// # Errors
/// The data set or a model cannot be read; the device fails.
pub fn compare(
    set: &Dataset,
    split: &str,
    scale: f64,
    locals: &[(String, PathBuf)],
    global: &Path,
    metric: Option<&Path>,
    device: Option<&str>,
) -> Result<Vec<Held>, EngineError> {
    let frames = set.select(split, None)?;
    let Some(first) = frames.first() else { return Ok(Vec::new()) };
    let size = set.load(*first, scale)?.image.dimensions();
    let mut metric = open_metric(metric, size)?;
    let owned = by_nearest_training_view(set, &frames, locals)?;
    let headers =
        locals.iter().map(|(_, path)| model::read_header(path).map(|h| h.0)).collect::<Result<Vec<_>, _>>()?;
    // Ground at the height of the origin is near enough for the hull of what cameras look at.
    let regions: Vec<_> = headers.iter().map(|h| Region::of(h, 0.0)).collect();
    let mut held = Vec::new();
    for (m, ((name, path), mine)) in locals.iter().zip(&owned).enumerate().filter(|(_, (_, mine))| !mine.is_empty()) {
        let mut own = Opened::new(path, set, size, device)?;
        let local = evaluate(&mut own.trainer, set, mine, scale, &own.into, metric.as_mut(), None)?;
        let photograph = set.load(mine[mine.len() / 2], scale)?;
        let shown = own.picture(&photograph.view)?;
        drop(own);
        let mut all = Opened::new(global, set, size, device)?;
        let scores = evaluate(&mut all.trainer, set, mine, scale, &all.into, metric.as_mut(), None)?;
        let pictures = [photograph.image.clone(), shown, all.picture(&photograph.view)?];
        let near: Vec<bool> =
            mine.iter().map(|i| is_near_border(set.frames[*i].view.pose.center, m, &regions)).collect();
        let near_border = near_border(&local, &scores, &near);
        let pictures = Some((photograph.name, pictures));
        held.push(Held { name: name.clone(), local, global: scores, near_border, pictures });
    }
    Ok(held)
}

/// Whether a camera of model `own` is in or beside another model's region.
fn is_near_border(camera: glam::DVec3, own: usize, regions: &[Option<Region>]) -> bool {
    let others = regions.iter().enumerate().filter(|(m, _)| *m != own).filter_map(|(_, r)| r.as_ref());
    others.into_iter().any(|r| r.distance(camera.truncate()) <= NEAR_BORDER_M)
}

/// Number and mean PSNR of the pictures that are near.
fn near_border(local: &Scores, global: &Scores, near: &[bool]) -> Option<(usize, [f64; 2])> {
    let count = near.iter().filter(|n| **n).count();
    let mean = |scores: &Scores| {
        let of_near = scores.views.iter().zip(near).filter(|(_, near)| **near);
        of_near.map(|(v, _)| v.psnr).sum::<f64>() / count as f64
    };
    (count > 0).then(|| (count, [mean(local), mean(global)]))
}

fn by_nearest_training_view(
    set: &Dataset,
    frames: &[usize],
    locals: &[(String, PathBuf)],
) -> Result<Vec<Vec<usize>>, EngineError> {
    let (known, mut centers) = (picture_names(set), Vec::new());
    for (m, (_, path)) in locals.iter().enumerate() {
        let header = model::read_header(path)?.0;
        let trained = known.pair(header.views.iter().map(|(name, _)| name.as_str()));
        centers.extend(trained.into_iter().flatten().map(|i| (m, set.frames[i].view.pose.center)));
    }
    let mut owned = vec![Vec::new(); locals.len()];
    for &i in frames {
        let at = set.frames[i].view.pose.center;
        let nearest = centers.iter().min_by(|a, b| a.1.distance(at).total_cmp(&b.1.distance(at)));
        if let Some((m, _)) = nearest {
            owned[*m].push(i);
        }
    }
    Ok(owned)
}

/// The global model's mean perceptual distance over all held-out pictures, when there is a metric.
pub fn perceptual(held: &[Held]) -> Option<Perceptual> {
    let name = held.iter().find_map(|h| h.global.perceptual.as_ref())?.name.clone();
    let all: Vec<f64> = held.iter().flat_map(|h| h.global.views.iter().filter_map(|v| v.perceptual)).collect();
    Some(Perceptual { name, mean: all.iter().sum::<f64>() / all.len() as f64 })
}

/// Puts the figures into the report's table and the pictures before the others.
pub fn add_to(data: &mut ReportData, held: Vec<Held>) {
    let views = |s: &Scores| s.views.len() as f64;
    let total: f64 = held.iter().map(|h| views(&h.global)).sum();
    if total <= 0.0 {
        return;
    }
    let mean = |of: &dyn Fn(&Scores) -> f64| held.iter().map(|h| of(&h.global) * views(&h.global)).sum::<f64>() / total;
    let (psnr, ssim) = (mean(&|s| s.psnr), mean(&|s| s.ssim));
    data.headline.push(("held-out PSNR".into(), format!("{psnr:.2} dB")));
    for row in &mut data.models {
        let own = held.iter().find(|h| h.name == row.name).map(|h| (h.local.psnr, h.local.ssim));
        let figures = if row.name == "global" { Some((psnr, ssim)) } else { own };
        (row.psnr, row.ssim) = (figures.map(|f| f.0), figures.map(|f| f.1));
    }
    let mut comparisons = Vec::new();
    for h in held {
        let lost = h.local.psnr - h.global.psnr;
        if lost > WORTH_A_WARNING_DB {
            data.warnings.push(format!(
                "On {}'s own held-out pictures the global model is {lost:.2} dB worse than the local one.",
                h.name
            ));
        }
        let row = [h.local.psnr, h.global.psnr].map(|v| format!("{v:.2}"));
        let near = h.near_border.map_or_else(
            || ["0", "–", "–"].map(String::from),
            |(count, [own, global])| [count.to_string(), format!("{own:.2}"), format!("{global:.2}")],
        );
        let row = [vec![h.name.clone(), h.local.views.len().to_string()], row.to_vec(), near.to_vec()].concat();
        match data.tables.iter_mut().find(|t| t.title == TABLE) {
            Some(table) => table.rows.push(row),
            None => data.tables.insert(
                0,
                pages::report::Table {
                    title: TABLE.into(),
                    note: format!(
                        "Each picture counts for the aircraft with the nearest training view; the last three columns are of those \
                         taken within {NEAR_BORDER_M:.0} m of another aircraft's region."
                    ),
                    head: ["", "pictures", "own model, dB", "global model, dB", "near a border", "own model, dB", "global model, dB"]
                        .map(String::from)
                        .to_vec(),
                    rows: vec![row],
                },
            ),
        }
        if let Some((title, pictures)) = h.pictures {
            let labels = ["photograph, held out", "the aircraft's own model", "global model"];
            let panels = labels.map(String::from).into_iter().zip(pictures).collect();
            comparisons.push(Comparison { title, note: h.name, panels });
        }
    }
    comparisons.append(&mut data.comparisons);
    data.comparisons = comparisons;
}

const TABLE: &str = "Held-out pictures";

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};

    use super::*;
    use engine::evaluate::ViewScore;

    #[test]
    fn pictures_near_a_border_are_those_in_or_beside_anothers_region() {
        let square = |x: f64| [[x, 0.0], [x + 50.0, 0.0], [x + 50.0, 50.0], [x, 50.0]].map(DVec2::from).to_vec();
        let regions = [Some(Region::declared(square(0.0))), Some(Region::declared(square(50.0))), None];
        let near = |x: f64, own| is_near_border(DVec3::new(x, 20.0, 40.0), own, &regions);
        assert_eq!([near(10.0, 0), near(39.0, 0), near(41.0, 0), near(60.0, 0)], [false, false, true, true]);
        assert_eq!([near(55.0, 1), near(65.0, 1)], [true, false]);
    }

    #[test]
    fn their_figures_are_the_means_of_those_alone() {
        let view =
            |psnr| ViewScore { name: String::new(), psnr, psnr_colors_fitted: psnr, ssim: 1.0, perceptual: None };
        let scores = |of: [f64; 3]| Scores { views: of.map(view).to_vec(), ..Scores::default() };
        let (local, global) = (scores([20.0, 30.0, 40.0]), scores([21.0, 32.0, 43.0]));
        assert_eq!(near_border(&local, &global, &[true, false, true]), Some((2, [30.0, 32.0])));
        assert_eq!(near_border(&local, &global, &[false; 3]), None);
    }
}
