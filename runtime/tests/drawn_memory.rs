//! What is drawn of a model's file: as if it were read whole, in the memory of a piece of it.
#![allow(clippy::expect_used, reason = "a test fails by panicking")]
#![allow(unsafe_code, reason = "the allocator that knows the peak")]

#[path = "../../tests/peak_allocator.rs"]
mod peak_allocator;

use std::sync::PoisonError;

use disk::Disk;
use engine::device::{file_renderer, renderer};
use engine::ortho::{Map, MapRequest};
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::delivery::Rounding;
use models::formats::model::{self, Chunks, ModelHeader, piece_bytes};
use peak_allocator::peak_of;
use survey::ortho::extent::SAMPLE;
use vulkan::gpu::Gpu;
use vulkan::trainer::{Rendering, Trainer};

/// The mark is the process's: one test at a time.
static ALONE: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Gaussians along each side of the ground, half a metre apart.
const ALONG: usize = 400;
const COUNT: usize = ALONG * ALONG;
/// Bytes of one of SH degree 3.
const BYTES: usize = 4 * (11 + 48);
/// The trainer's lists for a Gaussian: density control (24) and SH degrees.
const LISTS: usize = 64;

fn ground() -> GaussianCloud {
    let mut cloud = GaussianCloud::with_capacity(3, COUNT);
    for n in 0..COUNT {
        let [x, y] = [n % ALONG, n / ALONG];
        let mean = [x as f32 * 0.5 - 100.0, y as f32 * 0.5 - 100.0, 0.0];
        let colour = [(x % 7) as f32 * 0.1, (y % 5) as f32 * 0.1, 0.2].repeat(16);
        cloud.push(mean, [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 3.0, &colour);
    }
    cloud
}

/// From 50 m above, straight down.
fn view() -> View {
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
    let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
    let pose = Pose { rotation, center: DVec3::new(3.0, 5.0, 50.0) };
    View { intrinsics, pose }
}

fn drawn(trainer: &mut Trainer) -> Vec<f32> {
    let mut rendering = Rendering::default();
    trainer.render(&view(), &mut rendering).expect("rendered");
    rendering.rgb
}

#[test]
fn a_file_is_drawn_and_mapped_as_if_it_were_read_whole_in_the_memory_of_a_piece() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    if Gpu::list().is_err() {
        return needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
    }
    let dir = tempfile::tempdir().expect("temp dir");
    let path = dir.path().join("m.dgtr");
    let (cloud, header) = (ground(), ModelHeader::default());
    model::write(&path, &header, &cloud).expect("written");
    let request = MapRequest { gsd: Some(0.5), ..MapRequest::default() };
    let map_of_cloud = Map::of(&header, &cloud, &request).expect("a map").grid().size();
    let of_cloud = drawn(&mut renderer(None, &cloud, 64, 48).expect("a device"));
    drop(cloud);

    // A piece as it is read and as it is given away.
    let pieces = 2 * piece_bytes(3) as usize + (2 << 20);
    let (of_file, peak) = peak_of(|| drawn(&mut file_renderer(None, &path, (64, 48)).expect("a device").1));
    assert!(of_file.iter().any(|v| *v > 0.0) && of_file == of_cloud);
    let most = pieces + COUNT * LISTS;
    assert!(peak < most && most < COUNT * BYTES, "{peak} bytes of {most}; the cloud has {}", COUNT * BYTES);

    let (map_of_file, peak) = peak_of(|| {
        let model = Chunks::open(&path).expect("opens");
        Map::of_file(&model, &request).expect("a map").grid().size()
    });
    assert_eq!(map_of_file, map_of_cloud);
    let most = pieces + SAMPLE * 4 * 20;
    assert!(peak < most, "{peak} bytes of {most}");
}

#[test]
fn of_a_file_that_is_cut_short_what_is_there_is_drawn() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    if Gpu::list().is_err() {
        return needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
    }
    let dir = tempfile::tempdir().expect("temp dir");
    let path = dir.path().join("m.dgtr");
    model::write_rounded(&Disk::default(), &path, &ModelHeader::default(), &ground(), &Rounding::default())
        .expect("written");
    let whole = file_renderer(None, &path, (64, 48)).expect("a device").1.gaussians();
    let bytes = std::fs::read(&path).expect("read");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("cut");
    let part = file_renderer(None, &path, (64, 48)).expect("a part").1.gaussians();
    assert!(whole == COUNT && part > COUNT / 8 && part < COUNT, "{part} of {whole}");
}
