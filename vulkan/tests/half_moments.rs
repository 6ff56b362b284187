//! Adam's moments of SH in 16 bits: less memory, gradients within their rounding. What they do to training is among the
//! numerical cases (`vulkan::cases::half`).
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::{Plan, sh_columns};
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use vulkan::cases::half::request;
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;

fn open() -> Option<Gpu> {
    Gpu::open(None).map_err(|e| needs::missing(needs::Need::Vulkan, e)).ok()
}

#[test]
fn half_moments_halve_two_sections_and_nothing_else() {
    let [full, half] = [false, true].map(|h| Plan::with_capacities(&request(h), 512, 4096));
    for (a, b) in full.sections.iter().zip(&half.sections) {
        let moment = a.0.starts_with("sh_") && a.0.ends_with("moment");
        assert_eq!(b.1, if moment { a.1 / 2 } else { a.1 }, "{}", a.0);
    }
    assert_eq!(half.bytes("sh_first_moment"), 512 * sh_columns(3) * 8);
}

#[test]
fn gradients_are_read_back_from_half_moments_too() {
    let Some(gpu) = open() else { return };
    let (c, v) = (cloud(13, 200, 3), view(64, 48));
    let gradients = [false, true].map(|h| {
        let mut t = Fixture::new(&gpu, &Plan::new(&request(h)).unwrap(), &plain()).unwrap();
        t.load(&c).unwrap();
        t.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
        let mut into = GaussianCloud::default();
        t.gradient(0, &mut into).unwrap();
        into.sh
    });
    let largest = gradients[0].iter().fold(0.0f32, |m, g| m.max(g.abs()));
    assert!(largest > 0.0);
    for (whole, half) in gradients[0].iter().zip(&gradients[1]) {
        assert!((whole - half).abs() <= 1e-3 * whole.abs() + 1e-6 * largest, "{whole} {half}");
    }
}
