//! A scene that goes into the trainer and comes out of it piece by piece.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]
#![allow(unsafe_code, reason = "the allocator that knows the peak")]

#[path = "../../tests/peak_allocator.rs"]
mod peak_allocator;
mod scenes;

use std::cell::Cell;

use config::plan::{Plan, PlanRequest};
use models::cloud::GaussianCloud;
use peak_allocator::peak_of;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;
use vulkan::trainer::{LoadReport, TrainError};

/// The mark of memory is the process's: one test at a time.
static ALONE: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// A trainer of `on_device` Gaussians at once, of a scene of so many, with a view of 64 × 48.
fn trainer(on_device: usize, scene: usize) -> Option<Fixture> {
    let Ok(gpu) = Gpu::open(None) else {
        needs::missing(needs::Need::Vulkan, "no Vulkan device");
        return None;
    };
    let request = PlanRequest {
        device_mib: 128,
        width: 64,
        height: 48,
        views: 1,
        max_gaussians: Some(on_device),
        scene_gaussians: Some(scene),
        ..Default::default()
    };
    let mut trainer = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &plain()).unwrap();
    trainer.keep_scene_in(tempfile::tempfile().unwrap());
    let v = view(64, 48);
    trainer.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
    Some(trainer)
}

/// Places far apart, some Gaussians large, some not finite.
fn places(many: usize) -> GaussianCloud {
    let mut all = cloud(8, 300, 3);
    for place in 1..many {
        let mut other = cloud(8 + place as u64, 300, 3);
        other.means.iter_mut().for_each(|m| m[0] += 40.0 * place as f32);
        all.extend(&other);
    }
    for i in (0..all.len()).step_by(37) {
        all.log_scales[i] = [2.0, 1.0, -3.0];
    }
    (all.means[5][1], all.opacity_logits[77]) = (f32::NAN, f32::INFINITY);
    all
}

fn in_pieces(t: &mut Fixture, scene: &GaussianCloud, piece: usize) -> LoadReport {
    let rows: Vec<u32> = (0..scene.len() as u32).collect();
    t.load_pieces::<TrainError>(&|take| rows.chunks(piece).try_for_each(|rows| take(&scene.rows(rows)))).unwrap()
}

fn model(t: &mut Fixture) -> GaussianCloud {
    let mut model = GaussianCloud::default();
    t.snapshot(&mut model).unwrap();
    model
}

#[test]
fn a_scene_loaded_in_pieces_is_the_one_loaded_as_a_whole_to_the_bit_and_so_is_what_follows() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    let scene = places(4);
    // In cells, on the device as a whole, and more than there is room for.
    for (on_device, capacity) in [(500, 1200), (1300, 1300), (500, 900)] {
        let Some(mut whole) = trainer(on_device, capacity) else { return };
        let report = whole.load(&scene).unwrap();
        assert_eq!((report.loaded, report.dropped_non_finite), (1198.min(capacity), 2));
        let loaded = model(&mut whole);
        assert_eq!(whole.cells().0 > 0, on_device < report.loaded);
        (0..12).for_each(|_| _ = whole.step().unwrap());
        let trained = model(&mut whole);
        assert!(trained != loaded);
        for piece in [1200, 333, 7] {
            let mut t = trainer(on_device, capacity).unwrap();
            assert_eq!(in_pieces(&mut t, &scene, piece), report, "pieces of {piece}");
            assert!(model(&mut t) == loaded, "pieces of {piece}");
            (0..12).for_each(|_| _ = t.step().unwrap());
            assert!(model(&mut t) == trained, "pieces of {piece}");
        }
    }
}

#[test]
fn what_comes_out_in_pieces_is_the_snapshot() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    // More than one piece.
    for (on_device, capacity) in [(3_000, 45_000), (45_000, 45_000)] {
        let Some(mut t) = trainer(on_device, capacity) else { return };
        t.load(&places(140)).unwrap();
        (0..3).for_each(|_| _ = t.step().unwrap());
        let (mut all, mut pieces) = (GaussianCloud::with_capacity(3, 0), 0);
        let mut add = |piece: &mut GaussianCloud| {
            all.extend(piece);
            pieces += 1;
            Ok::<(), TrainError>(())
        };
        t.each_piece(&mut add).unwrap();
        assert!(pieces == 3 && all == model(&mut t), "{pieces} pieces");
        let refused = t.each_piece(&mut |_| Err(TrainError::NoViews)).unwrap_err();
        assert_eq!(refused, TrainError::NoViews, "an error of the taker ends it");
        t.step().unwrap();
    }
}

#[test]
fn a_snapshot_is_blended_with_a_later_one_row_by_row_without_memory_of_its_own() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    // The device holds all; the file holds most.
    for (on_device, capacity) in [(1_300, 1_300), (500, 1_300)] {
        let Some(mut t) = trainer(on_device, capacity) else { return };
        t.load(&places(4)).unwrap();
        let earlier = model(&mut t);
        (0..12).for_each(|_| _ = t.step().unwrap());
        let (later, mut blended) = (model(&mut t), earlier.clone());
        let (done, bytes) = peak_of(|| t.blend_into(&mut blended, 0.25));
        done.unwrap();
        assert!(bytes < 1 << 12, "{bytes} bytes for {} Gaussians", later.len());
        let numbers = |c: &GaussianCloud| {
            let shapes = [c.means.as_flattened(), c.log_scales.as_flattened(), c.rotations.as_flattened()].concat();
            [shapes, c.opacity_logits.clone(), c.sh.clone()].concat()
        };
        let (a, b, c) = (numbers(&earlier), numbers(&later), numbers(&blended));
        assert!(a != b && a.len() == c.len());
        for ((a, b), c) in a.iter().zip(&b).zip(&c) {
            assert_eq!(*c, a + 0.25 * (b - a));
        }
    }
}

/// Ground of `side`² Gaussians, a row at a time.
fn ground(side: usize, take: &mut dyn FnMut(&GaussianCloud) -> Result<(), TrainError>) -> Result<(), TrainError> {
    (0..side).try_for_each(|y| {
        let mut row = GaussianCloud::with_capacity(3, side);
        for x in 0..side {
            let mean = [0.2 * x as f32, 0.2 * y as f32, 0.0];
            row.push(mean, [-2.0, -2.0, -4.0], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.1; 48]);
        }
        take(&row)
    })
}

#[test]
fn memory_does_not_grow_with_the_scene_on_the_way_in_or_out() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    let mut most = [[0; 2]; 2];
    for (most, side) in most.iter_mut().zip([150, 450]) {
        let Some(mut t) = trainer(5_000, side * side) else { return };
        let (report, way_in) = peak_of(|| t.load_pieces(&|take| ground(side, take)).unwrap());
        assert_eq!(report.loaded, side * side);
        let mut seen = 0;
        let mut count = |piece: &mut GaussianCloud| {
            seen += piece.len();
            Ok::<(), TrainError>(())
        };
        let (_, way_out) = peak_of(|| t.each_piece(&mut count).unwrap());
        assert_eq!(seen, side * side);
        *most = [way_in, way_out];
        // Two lists of cells while the scene is divided; a piece of 16,384 Gaussians.
        let planned = t.plan().cells() * 256 + (1 << 20);
        assert!(way_in < planned && way_out < (16 << 10) * 236 + (64 << 10), "{side}: {way_in} and {way_out} bytes");
    }
    println!("{most:?} bytes for 22,500 and 202,500 Gaussians of 236 bytes");
    // Nine times the scene: its cells, of hundreds of Gaussians each, and nothing else.
    assert!(most[1][0] < most[0][0] + 180_000 && most[1][1] == most[0][1], "{most:?}");
}

#[test]
fn a_source_that_fails_or_changes_is_an_error_and_the_next_scene_is_whole() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    let scene = places(4);
    for on_device in [500, 1300] {
        let Some(mut t) = trainer(on_device, 1300) else { return };
        let expected = {
            t.load(&scene).unwrap();
            model(&mut t)
        };
        // After so many readings it fails, or gives fewer, more, or others.
        let mut noticed = [0; 4];
        for (readings, change) in (0..20).flat_map(|readings| (0..4).map(move |change| (readings, change))) {
            let read = Cell::new(0);
            let loaded = t.load_pieces::<TrainError>(&|take| {
                let over = read.replace(read.get() + 1) >= readings;
                take(&scene.rows(&(0..600).collect::<Vec<_>>()))?;
                let mut rest = scene.rows(&(600..1200).collect::<Vec<_>>());
                match change {
                    0 if over => return Err(TrainError::NoViews),
                    1 if over => return Ok(()),
                    2 if over => take(&rest)?,
                    3 if over => rest.means.iter_mut().for_each(|m| m[1] += 5e4),
                    _ => {}
                }
                take(&rest)
            });
            match loaded {
                // It was read less often, or was the same every time; where Gaussians lie matters at the last two readings.
                Ok(_) => assert!(read.get() <= readings || change == 3 || change > 0 && readings == 0),
                Err(e) => {
                    assert_eq!(e, if change == 0 { TrainError::NoViews } else { TrainError::SceneChanged });
                    noticed[change] += 1;
                }
            }
        }
        assert!(noticed[..3].iter().all(|n| *n > 0) && (noticed[3] > 0 || on_device == 1300), "{noticed:?}");
        t.load(&scene).unwrap();
        assert!(model(&mut t) == expected);
        t.step().unwrap();
    }
}
