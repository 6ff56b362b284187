//! Crops of key frames that are larger than what they are trained at: what the training picture cannot show.

use config::training::CropSettings;
use image::{RgbImage, imageops};
use job::console::Progress;
use job::run_json::RunReport;
use models::camera::View;
use models::mask::Mask;
use models::picture::crops::{Crop, crops, finest};
use vulkan::trainer::CropPlace;

use super::Training;
use crate::error::EngineError;
use crate::source::PictureSource;

/// Shares of the camera's size at which crops are cut: halves, which JPEG files are decoded at for less.
const SCALES: [f64; 4] = [1.0, 0.5, 0.25, 0.125];

/// Cuts crops out of all key frames, which `source` decodes once more, as many as were planned: all of the largest size whose crops
/// find room, or of each picture those with the most detail. False when `cancelled` said so.
///
/// # Errors
/// A picture that was there cannot be read any more; the file of the views cannot be written.
pub(crate) fn cut(
    training: &mut Training,
    views: &[(String, View)],
    source: &mut dyn PictureSource,
    cancelled: &dyn Fn() -> bool,
    report: &mut RunReport,
) -> Result<bool, EngineError> {
    let most = training.trainer.plan().crops;
    if most == 0 || training.pictures.store.crops() > 0 {
        return Ok(true);
    }
    let _span = tracing::info_span!("crops").entered();
    let from = std::time::Instant::now();
    let Some(scale) = scale_of(&training.settings.crops, views, source, most) else { return Ok(true) };
    let share = most / views.len().max(1);
    let mut progress = Progress::new("crops", views.len() as u64);
    let mut size = (0, 0);
    for (i, (name, view)) in views.iter().enumerate() {
        if let Some((whole, mask)) = source.whole(name, scale)? {
            size = whole.dimensions();
            let whole = training.pictures.in_common_light(i, view, whole);
            add(training, (i, view), &whole, mask.as_ref(), share)?;
        }
        progress.set(i as u64 + 1, || name.clone());
        if cancelled() {
            return Ok(false);
        }
    }
    report.stage("crops", from);
    report.more.insert("crops".into(), training.pictures.store.crops().into());
    tracing::info!("{} crops of pictures of {}x{}", training.pictures.store.crops(), size.0, size.1);
    Ok(true)
}

/// The largest scale at which all crops of all key frames are at most `most`, or else the smallest; `None` where pictures are
/// trained as large as they are.
fn scale_of(settings: &CropSettings, views: &[(String, View)], source: &dyn PictureSource, most: usize) -> Option<f64> {
    let scales = settings.scale.map_or_else(|| SCALES.to_vec(), |scale| vec![f64::from(scale)]);
    let mut chosen = None;
    for scale in scales {
        let mut all = 0;
        for (name, view) in views {
            let (width, height) = source.size_of(name)?;
            let edge = |side: u32| (f64::from(side) * scale).round() as u32;
            all += settings.planned((edge(width), edge(height)), (view.intrinsics.width, view.intrinsics.height));
        }
        if all > 0 {
            chosen = Some(scale);
            if all as usize <= most {
                break;
            }
        }
    }
    chosen
}

/// Cuts the `share` crops with the most detail out of the picture of a view.
fn add(
    training: &mut Training,
    (index, view): (usize, &View),
    whole: &RgbImage,
    mask: Option<&Mask>,
    share: usize,
) -> Result<(), EngineError> {
    let lens = view.intrinsics;
    let factor = (f64::from(whole.width()) / f64::from(lens.width)).ceil() as u32;
    let mut windows = crops(whole, (lens.width, lens.height), factor);
    let masks = |c: &Crop| mask.map(|mask| mask.window(c.x, c.y, c.width, c.height));
    // What is left out has no detail worth a crop.
    for c in &mut windows {
        let pixels = (c.width * c.height) as f32;
        c.detail *= masks(c).map_or(1.0, |mask| mask.count() as f32 / pixels);
    }
    for c in finest(&windows, share) {
        let image = imageops::crop_imm(whole, c.x, c.y, c.width, c.height).to_image();
        let place = CropPlace { x: c.x, y: c.y, whole: whole.dimensions() };
        let device = training.trainer.device_mut();
        training.pictures.store.add_crop(device, index, &image, masks(&c).as_ref(), place)?;
    }
    Ok(())
}
