//! Held-out quality of a model: renders the pictures of a split and compares, next to the two naive baselines.

use std::path::{Path, PathBuf};

pub mod heights;
pub mod surveyed;

use models::baselines::{MeanColor, nearest_view, warp_over_ground};
use models::camera::{PosedImage, View};
use models::formats::model::ModelHeader;
use models::formats::write_atomic;
use models::light::PictureLight;
use models::metrics::{colors_fitted, psnr, ssim_where, to_f32, to_rgb8};
use models::onnx::metric::PerceptualMetric;
use serde::Serialize;
use survey::dataset::Dataset;
use vulkan::trainer::{Rendering, Trainer};

use crate::error::EngineError;
use crate::renderings;
use crate::tiles;
use crate::transfer::PoseTransfer;

/// PSNR of equal pictures; JSON has no infinity.
const PSNR_CAP: f64 = 100.0;

/// One view's figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    /// Name of the picture.
    pub name: String,
    /// dB, at most 100.
    pub psnr: f64,
    /// dB with the rendering's colours fitted to the picture's: exposure and white balance, which no model can know of a picture
    /// that it has not seen, are left out of it.
    pub psnr_colors_fitted: f64,
    /// −1…1.
    pub ssim: f64,
    /// Distance by the user's metric, when there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub perceptual: Option<f64>,
}

/// A perceptual metric over several views.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Perceptual {
    /// Which metric: the name in its manifest.
    pub name: String,
    /// Mean distance, in the metric's own unit.
    pub mean: f64,
}

/// Figures over several views: means of the views' figures.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Scores {
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean PSNR with colours fitted, dB.
    pub psnr_colors_fitted: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Mean of the user's metric, when there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub perceptual: Option<Perceptual>,
    /// Each view.
    pub views: Vec<ViewScore>,
}

impl Scores {
    fn of(views: Vec<ViewScore>) -> Self {
        let n = views.len().max(1) as f64;
        let mean = |f: fn(&ViewScore) -> f64| views.iter().map(f).sum::<f64>() / n;
        Self {
            psnr: mean(|v| v.psnr),
            psnr_colors_fitted: mean(|v| v.psnr_colors_fitted),
            ssim: mean(|v| v.ssim),
            perceptual: None,
            views,
        }
    }

    fn with_metric(mut self, metric: Option<&PerceptualMetric>) -> Self {
        let distances: Vec<f64> = self.views.iter().filter_map(|v| v.perceptual).collect();
        if let Some(metric) = metric.filter(|_| !distances.is_empty()) {
            let mean = distances.iter().sum::<f64>() / distances.len() as f64;
            self.perceptual = Some(Perceptual { name: metric.name().to_owned(), mean });
        }
        self
    }
}

/// The two naive guesses.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BaselineScores {
    /// Nearest training picture warped over the plane z = 0.
    pub ground_warp: Scores,
    /// Mean colour of the training pictures.
    pub mean_color: Scores,
}

/// How a data set's pictures come into a model's frame, and what light they are expected in.
#[derive(Clone, Debug)]
pub struct IntoModel {
    /// Poses.
    pub transfer: PoseTransfer,
    views: Vec<View>,
    lights: Vec<PictureLight>,
}

impl IntoModel {
    /// Of pictures of `set` into the model of `header`.
    pub fn of(set: &Dataset, header: &ModelHeader) -> Self {
        Self {
            transfer: PoseTransfer::between(set, &header.views),
            views: header.views.iter().map(|v| v.1).collect(),
            lights: header.lights.clone(),
        }
    }

    /// The light of a picture taken at `view` of the model's frame, as the pictures tell that the model was trained on.
    fn light(&self, view: &View) -> PictureLight {
        PictureLight::near(self.views.iter(), &self.lights, view)
    }
}

/// Renders and scores `frames` of `set`.
///
/// Poses are the data set's, carried into the model's frame. The rendering is put into the light that is
/// expected there and rounded to 8 bits first, so that the figures are those of the pictures that `save` receives (see [`saved`]).
/// `metric` is asked too, when given.
///
/// # Errors
/// A picture cannot be read, the device or the metric fails, or `save` cannot be written to.
pub fn evaluate(
    trainer: &mut Trainer,
    set: &Dataset,
    frames: &[usize],
    scale: f64,
    into: &IntoModel,
    mut metric: Option<&mut PerceptualMetric>,
    save: Option<&Path>,
) -> Result<Scores, EngineError> {
    let mut rendering = Rendering::default();
    let mut scores = Vec::with_capacity(frames.len());
    let files = saved(set, frames)?;
    for (&i, file) in frames.iter().zip(&files) {
        let truth = set.load(i, scale)?;
        let view = View { intrinsics: truth.view.intrinsics, pose: into.transfer.apply(&truth.view.pose) };
        tiles::render(trainer, &view, &mut rendering)?;
        let Some(mut picture) = to_rgb8(&rendering.rgb, rendering.width, rendering.height) else {
            return Err(EngineError::RenderingSize(truth.name));
        };
        PictureLight::default().change(&into.light(&view), &mut picture, &view.intrinsics);
        if let Some(dir) = save {
            save_png(&picture, &dir.join(file))?;
        }
        let mut view = score(&truth, &to_f32(&picture));
        // A metric that knows no masks is shown the truth where nothing is compared.
        if let Some(mask) = &truth.mask {
            let places = picture.enumerate_pixels_mut().zip(truth.image.pixels());
            places.filter(|((x, y, _), _)| !mask.keeps(*x, *y)).for_each(|((_, _, p), truth)| *p = *truth);
        }
        if let Some(metric) = &mut metric {
            view.perceptual = Some(metric.distance(&truth.image, &picture)?);
        }
        scores.push(view);
    }
    Ok(Scores::of(scores).with_metric(metric.as_deref()))
}

/// Where below its folder [`evaluate`] saves the renderings of `frames`.
///
/// # Errors
/// Two pictures have one name.
pub fn saved(set: &Dataset, frames: &[usize]) -> Result<Vec<PathBuf>, EngineError> {
    let names: Vec<&str> = frames.iter().map(|&i| set.frames[i].name.as_str()).collect();
    Ok(renderings::places(&names, &[".png"])?.into_iter().flatten().collect())
}

/// Scores both baselines on the same pictures. `training` are the frames that a guess may use.
///
/// # Errors
/// A picture cannot be read.
pub fn baselines(
    set: &Dataset,
    training: &[usize],
    frames: &[usize],
    scale: f64,
) -> Result<BaselineScores, EngineError> {
    let mut mean = MeanColor::default();
    for &i in training {
        mean.add(&set.load(i, scale)?);
    }
    let views: Vec<View> = training.iter().map(|&i| set.frames[i].view).collect();
    let (mut warped, mut flat) = (Vec::new(), Vec::new());
    for &i in frames {
        let truth = set.load(i, scale)?;
        let guess = match nearest_view(&truth.view, &views) {
            Some(n) => warp_over_ground(&set.load(training[n], scale)?, &truth.view, mean.get()),
            None => mean.picture(truth.view.intrinsics.pixels()),
        };
        warped.push(score(&truth, &guess));
        flat.push(score(&truth, &mean.picture(truth.view.intrinsics.pixels())));
    }
    Ok(BaselineScores { ground_warp: Scores::of(warped), mean_color: Scores::of(flat) })
}

fn score(truth: &PosedImage, rgb: &[f32]) -> ViewScore {
    let k = &truth.view.intrinsics;
    let target = to_f32(&truth.image);
    let kept = |i: usize| truth.keeps(i as u32 % k.width, i as u32 / k.width);
    // What is left out counts as rendered right in the windows that reach over it, and not at all by itself.
    let shown: Vec<f32> = (0..target.len())
        .map(|i| if kept(i / 3) { rgb.get(i).copied().unwrap_or(f32::NAN) } else { target[i] })
        .collect();
    let of = |values: &[f32]| -> Vec<f32> { (0..values.len()).filter(|i| kept(i / 3)).map(|i| values[i]).collect() };
    let (seen, wanted) = (of(&shown), of(&target));
    ViewScore {
        name: truth.name.clone(),
        psnr: psnr(&seen, &wanted).min(PSNR_CAP),
        psnr_colors_fitted: psnr(&colors_fitted(&seen, &wanted), &wanted).min(PSNR_CAP),
        ssim: ssim_where(&shown, &target, k.width as usize, k.height as usize, kept),
        perceptual: None,
    }
}

/// The metric that a manifest describes, for pictures of `size`.
///
/// # Errors
/// The manifest, the network or ONNX Runtime is missing or does not fit.
pub fn open_metric(manifest: Option<&Path>, size: (u32, u32)) -> Result<Option<PerceptualMetric>, EngineError> {
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get().min(4));
    Ok(manifest.map(|path| PerceptualMetric::open(path, size, threads)).transpose()?)
}

/// Writes an 8-bit RGB PNG, atomically.
///
/// # Errors
/// The folder cannot be written to.
pub fn save_png(picture: &image::RgbImage, path: &Path) -> Result<(), EngineError> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|source| EngineError::Encode { path: path.to_owned(), source })?;
    Ok(write_atomic(path, |out| out.write_all(bytes.get_ref()))?)
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use image::{Rgb, RgbImage};
    use models::camera::{Intrinsics, Pose, PoseSigma};
    use models::mask::Mask;

    use super::*;

    #[test]
    fn what_a_mask_leaves_out_is_not_scored() {
        let intrinsics = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 16.0, cy: 12.0 };
        let pose = Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO };
        let truth = |mask| PosedImage {
            name: "a.jpg".into(),
            time_ns: 0,
            image: RgbImage::from_fn(32, 24, |x, y| Rgb([(7 * x) as u8, (9 * y) as u8, 80])),
            mask,
            view: View { intrinsics, pose },
            sigma: PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] },
        };
        let masked = truth(Some(Mask::from_fn(32, 24, |x, _| x < 20)));
        let mut rgb = to_f32(&masked.image);
        rgb.iter_mut().enumerate().filter(|(i, _)| i / 3 % 32 >= 20).for_each(|(_, v)| *v = 1.0 - *v);
        let score_of = |truth: &PosedImage| (score(truth, &rgb).psnr, score(truth, &rgb).ssim);
        assert_eq!(score_of(&masked), (PSNR_CAP, 1.0));
        assert!(score(&masked, &rgb).psnr_colors_fitted > 80.0, "what is left out is not fitted to");
        let whole = score_of(&truth(None));
        assert!(whole.0 < 20.0 && whole.1 < 0.9, "{whole:?}");
        // An error of a tenth everywhere is 20 dB over whatever part is looked at.
        let off: Vec<f32> = to_f32(&masked.image).iter().map(|v| v + 0.1).collect();
        assert!((score(&masked, &off).psnr - 20.0).abs() < 1e-3);
        assert!(score(&masked, &rgb[..30]).ssim.is_nan(), "a rendering of another size");
    }
}
