//! What a mask leaves out of a picture has no part in training.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::training::ResolutionSettings;
use models::camera::{DepthPrior, PosedImage};
use models::cloud::GaussianCloud;
use models::mask::Mask;
use scenes::device::{empty_trainer, plain, posed};
use scenes::{cloud, photo, view};
use vulkan::gpu::Gpu;

fn dark(x: u32, y: u32) -> bool {
    (12..33).contains(&x) && y >= 9
}

#[test]
fn what_lies_under_a_mask_changes_no_bit_of_the_model_at_any_resolution() {
    if Gpu::open(None).is_err() {
        return needs::missing(needs::Need::Vulkan, "no Vulkan device");
    }
    let v = view(64, 48);
    let honest = posed(&v, &photo(1, &v));
    let mut painted = honest.clone();
    for (x, y, p) in painted.image.enumerate_pixels_mut().filter(|(x, y, _)| dark(*x, *y)) {
        *p = image::Rgb([(x * 91 + y) as u8, 255, (y * 53) as u8]);
    }
    let mask = Mask::from_fn(64, 48, |x, y| !dark(x, y));
    let ramp = |wrong: bool| {
        let depth =
            |i: u32| if wrong && dark(i % 64, i / 64) { 900.0 - 8.0 * i as f32 / 64.0 } else { 3.0 + (i % 64) as f32 };
        DepthPrior { width: 64, height: 48, depth: (0..64 * 48).map(depth).collect(), confidence: vec![1.0; 64 * 48] }
    };
    for half_until in [0.0, 1.0] {
        let mut settings = plain();
        settings.resolution =
            ResolutionSettings { quarter_until: 0.0, half_until, least_side: 1, ..Default::default() };
        let after = |picture: &PosedImage, wrong: bool, mask: Option<&Mask>| {
            let mut trainer = empty_trainer(3, 300, &v, &settings).unwrap();
            trainer.load(&cloud(8, 300, 3)).unwrap();
            let picture = PosedImage { mask: mask.cloned(), ..picture.clone() };
            // The range of a prior's depths is its own matter: both have the same.
            let mut prior = ramp(wrong);
            (prior.depth[0], prior.depth[1]) = (0.5, 1000.0);
            trainer.add_view(&picture, Some(&prior)).unwrap();
            let losses: Vec<f32> = (0..30).map(|_| trainer.step().unwrap().loss).collect();
            let mut model = GaussianCloud::with_capacity(3, 300);
            trainer.snapshot(&mut model).unwrap();
            (losses, model)
        };
        let masked = after(&honest, false, Some(&mask));
        assert!(masked == after(&painted, true, Some(&mask)), "half size: {}", half_until > 0.0);
        assert!(masked != after(&honest, false, None), "a mask has an effect");
        assert!(after(&honest, false, None) != after(&painted, false, None), "without a mask it is learnt");
        assert!(after(&honest, false, None) != after(&honest, true, None), "and so is a depth");
    }
}

#[test]
fn a_new_depth_prior_leaves_the_mask_in_place_and_a_picture_keeps_its_own_colours() {
    if Gpu::open(None).is_err() {
        return needs::missing(needs::Need::Vulkan, "no Vulkan device");
    }
    let v = view(64, 48);
    let mask = Mask::from_fn(64, 48, |x, y| !dark(x, y));
    let picture = PosedImage { mask: Some(mask.clone()), ..posed(&v, &photo(1, &v)) };
    let mut trainer = empty_trainer(3, 300, &v, &plain()).unwrap();
    trainer.add_view(&picture, None).unwrap();
    // Confidences that would read as the mark, and none at all.
    for confidence in [1.0 / 255.0, 0.0, 1.0] {
        let n = 64 * 48;
        let depth = (0..n).map(|i| i as f32 + 1.0).collect();
        let prior = DepthPrior { width: 64, height: 48, depth, confidence: vec![confidence; n] };
        trainer.set_prior(0, Some(&prior)).unwrap();
        assert_eq!(trainer.view_mask(0).unwrap().as_ref(), Some(&mask), "{confidence}");
    }
    assert!(trainer.view_image(0).unwrap() == picture.image);
    let mut plain_one = empty_trainer(3, 300, &v, &plain()).unwrap();
    plain_one.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
    assert_eq!(plain_one.view_mask(0).unwrap(), None);
}
