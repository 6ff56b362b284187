//! Promise of levels of detail: each is the scene, from where it takes its place.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use bench::levels::{measure, write_scene};
use vulkan::gpu::Gpu;

#[test]
fn every_level_shows_the_scene_from_the_distance_where_its_voxels_are_pixels() {
    if Gpu::open(None).is_err() {
        needs::missing(needs::Need::Vulkan, "no Vulkan device");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene.dgtr");
    write_scene(&scene, 200_000, 0).unwrap();
    let all = measure(&scene, &folder.path().join("streamed"), None).unwrap();
    assert!(all.levels.len() >= 3, "{all:?}");
    for level in &all.levels[1..] {
        println!("{} Gaussians, {:.0} m: {:.2?} dB", level.gaussians, level.distance_m, level.psnr);
        // From farther away the rim of the scene, where both are cut off, is most of what is seen.
        assert!(level.psnr[0] >= 30.0, "{level:?}");
    }
}
