//! Promises of growth in flight, on a survey over the ray-cast world.

use std::ops::ControlFlow;

use config::budget::Memory;
use config::refine::RefineSettings;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::cloud::GaussianCloud;
use models::formats::model::ModelHeader;
use sim::world::{PinholeView, World, WorldSettings};
use vulkan::gpu::Gpu;
use vulkan::trainer::{RunBudget, StepReport};

use super::*;
use crate::device::DeviceRequest;
use crate::testing::settings;
use crate::{EngineSettings, InitKind, Reconstruct, Reconstruction};

const LENS: Intrinsics = Intrinsics { width: 240, height: 180, fx: 195.0, fy: 195.0, cx: 120.0, cy: 90.0 };
/// Pictures of a line, and lines.
const LINE: usize = 14;
const LINES: usize = 4;

/// Straight down from 42 m, 12 m to the next picture and 18 m to the next line, back and forth; positions wrong by decimetres.
fn flight() -> Vec<PosedImage> {
    let world = World::new(5, &WorldSettings { half_extent_m: 140.0, ..WorldSettings::default() });
    let rotation = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
    let picture = |i: usize| {
        let (line, along) = (i / LINE, i % LINE);
        let along = if line % 2 == 0 { along } else { LINE - 1 - along };
        let center = DVec3::new(12.0 * along as f64 - 78.0, 18.0 * line as f64 - 27.0, 42.0);
        let view = PinholeView {
            width: LENS.width,
            height: LENS.height,
            fx: LENS.fx.into(),
            fy: LENS.fy.into(),
            cx: LENS.cx.into(),
            cy: LENS.cy.into(),
            position: center,
            rotation,
        };
        let wrong = |k: usize| ((i * 37 + k * 53) % 19) as f64 / 19.0 - 0.5;
        let pose = Pose { rotation, center: center + DVec3::new(wrong(0), wrong(1), wrong(2)) };
        PosedImage {
            name: format!("{i:03}.png"),
            time_ns: 1_000_000_000 * (1 + 2 * i as u64),
            image: world.render(&view).0,
            view: View { intrinsics: LENS, pose },
            mask: None,
            sigma: PoseSigma { position_m: [0.5; 3], rotation_rad: [0.02; 3] },
        }
    };
    (0..LINE * LINES).map(picture).collect()
}

/// An engine in flight; `None`, with a word about it, where device or ONNX Runtime are missing.
fn engine() -> Option<Reconstruction> {
    engine_in(None, None).map(|engine| engine.expect("opens"))
}

/// An engine in flight in so much of the host's memory, MiB, on a device that holds so many of all Gaussians.
fn engine_in(host_mib: Option<u32>, on_device: Option<u32>) -> Option<Result<Reconstruction, EngineError>> {
    if Gpu::list().is_err() {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
        return None;
    }
    if models::onnx::session::find_library().is_err() {
        needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime (sh runtime/setup.sh)");
        return None;
    }
    let mut settings = EngineSettings {
        camera_pixels: LENS.pixels() as u64,
        refine: Some(RefineSettings::default()),
        start: InitKind::FeedForward,
        incremental: true,
        ..settings()
    };
    let (size, views, all) = ((LENS.width, LENS.height), LINE * LINES, 30_000);
    let (max_gaussians, scene_gaussians) = (on_device.or(Some(all)), on_device.map(|_| all));
    let memory = Memory { device_mib: Some(96), host_mib, max_gaussians, scene_gaussians, view_slots: None };
    settings.device = DeviceRequest { memory, size, views, ..settings.device };
    let region = vec![[-78.0, -27.0], [78.0, -27.0], [78.0, 27.0], [-78.0, 27.0]];
    Some(Reconstruction::open(settings, ModelHeader { region, ..ModelHeader::default() }, "fly"))
}

#[test]
fn what_waits_of_few_pictures_goes_to_a_file_when_the_host_has_no_room_for_it() {
    let planned = |engine: &Reconstruction| engine.report.more["host_bytes_planned"].as_u64().expect("bytes");
    let Some(roomy) = engine() else { return };
    let bytes = planned(&roomy);
    drop(roomy);
    let mib = |bytes: u64| Some((bytes >> 20) as u32);
    // A little less: one of the two files does. As little as both save: the other, too. Less than that is refused.
    let little = engine_in(mib(bytes - (1 << 20)), None).expect("as before").expect("fits");
    assert!(planned(&little) < bytes - (1 << 20));
    let least = planned(&engine_in(mib(planned(&little) - (1 << 20)), None).expect("as before").expect("fits"));
    assert!(least < planned(&little) - (1 << 20));
    let refused = engine_in(mib(least - (1 << 20)), None).expect("as before").map(drop);
    assert!(matches!(refused, Err(EngineError::HostMemory { .. })), "{refused:?}");
}

/// What one growth did.
#[derive(Clone, Copy, Debug)]
struct Done {
    whole: bool,
    depths: u64,
    frames: u64,
    observations: u64,
}

/// Takes a picture in as a flight does, with three steps of training behind it; what was done where the model grew.
fn take(engine: &mut Reconstruction, picture: PosedImage) -> Option<Done> {
    engine.add(picture, false).expect("taken");
    let counts = |e: &Reconstruction| {
        let t = &e.grown;
        [t.depths, t.adjusted_frames, t.adjusted_observations]
    };
    let mut done = None;
    if engine.wants_build(false) {
        assert!(engine.build(&|| false).expect("built"));
    } else if engine.wants_growth() {
        let before = counts(engine);
        let whole = engine.grow().expect("grown");
        let [depths, ..] = counts(engine);
        let [_, frames, observations] = before;
        done = Some(Done { whole, depths: depths - before[0], frames, observations });
    }
    if engine.has_model() {
        let mut steps = 0;
        let mut each = |_: &StepReport| {
            steps += 1;
            if steps == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        engine.train(&RunBudget { steps: Some(10_000), seconds: None }, &mut each).expect("trains");
    }
    done
}

fn snapshot(engine: &mut Reconstruction) -> GaussianCloud {
    let mut cloud = GaussianCloud::default();
    engine.training.trainer.snapshot(&mut cloud).expect("read");
    cloud
}

#[test]
fn every_picture_is_in_the_model_at_once_at_a_cost_that_does_not_grow_with_the_flight() {
    let (pictures, Some(mut engine)) = (flight(), engine()) else { return };
    let mut grown: Vec<Done> = Vec::new();
    for (i, picture) in pictures.into_iter().enumerate() {
        grown.extend(take(&mut engine, picture));
        assert!(i < 2 || engine.training.built.views.len() == i + 1, "picture {i} waits for nothing");
    }
    assert_eq!(grown.len(), LINE * LINES - 3, "built once, of three");
    // What placing took is counted before the growth: of each, the difference to the next.
    let near: Vec<(u64, u64, u64)> = grown
        .windows(2)
        .filter(|w| !w[1].whole)
        .map(|w| (w[1].depths, w[1].frames - w[0].frames, w[1].observations - w[0].observations))
        .collect();
    let whole = grown.iter().filter(|g| g.whole).count();
    assert!((4..=11).contains(&whole), "all poses at growing intervals: {whole}");
    assert!(near.iter().all(|n| n.0 <= 4 && n.1 <= 7), "{near:?}");
    // The second line against the last: as many neighbours.
    let mean =
        |of: &[(u64, u64, u64)], k: fn(&(u64, u64, u64)) -> u64| of.iter().map(k).sum::<u64>() as f64 / of.len() as f64;
    let (early, late) = (&near[LINE..2 * LINE - 4], &near[near.len() - 10..]);
    let (then, now) = (mean(early, |n| n.2), mean(late, |n| n.2));
    assert!(then > 200.0 && now < 1.4 * then, "observations {then} {now}: {near:?}");
    assert!(mean(late, |n| n.0) < 1.4 * mean(early, |n| n.0), "depths: {near:?}");
}

#[test]
fn a_flight_over_more_than_the_device_holds_grows_as_well() {
    let Some(engine) = engine_in(None, Some(6_000)) else { return };
    let (pictures, mut engine) = (flight(), engine.expect("opens"));
    let mut grown = 0;
    for (i, picture) in pictures.into_iter().take(2 * LINE).enumerate() {
        grown += usize::from(take(&mut engine, picture).is_some());
        assert!(i < 2 || engine.training.built.views.len() == i + 1, "picture {i} waits for nothing");
    }
    assert_eq!((grown, engine.training.built.times), (2 * LINE - 3, 1), "built once, of three");
    let (cells, on_device) = engine.training.trainer.cells();
    assert!(cells > on_device && on_device > 0, "{on_device} of {cells} cells");
    let model = snapshot(&mut engine);
    assert!(model.len() > 6_000 && model.len() == engine.gaussians(), "{} {}", model.len(), engine.gaussians());
    // To make room and to give up is done in cells, too.
    make_room(&mut engine.training, 1_000).expect("made");
    assert_eq!(engine.gaussians(), model.len() - 1_000);
    engine.shrink().expect("shrinks");
    assert!(engine.gaussians() < model.len() - 2_000);
    engine.land();
    assert!(engine.build(&|| false).expect("built"));
}

#[test]
fn new_ground_gets_gaussians_and_what_is_far_from_it_stays_to_the_bit() {
    let (pictures, Some(mut engine)) = (flight(), engine()) else { return };
    let seen = |cloud: &GaussianCloud, x: f32| {
        cloud.means.iter().filter(|m| (m[0] - x).abs() < 6.0 && (m[1] + 27.0).abs() < 6.0).count()
    };
    let mut looked_at = 0;
    for picture in pictures.into_iter().take(LINE) {
        let (there, first) = (picture.view.pose.center.x as f32, engine.poses.len());
        if first < 6 {
            take(&mut engine, picture);
            continue;
        }
        let before = snapshot(&mut engine);
        engine.add(picture, false).expect("taken");
        let whole = engine.grow().expect("grown");
        let after = snapshot(&mut engine);
        // Half a picture ahead was hardly seen before.
        let ahead = there + 20.0;
        assert!(seen(&after, ahead) > seen(&before, ahead) + 20, "{} {}", seen(&before, ahead), seen(&after, ahead));
        if !whole {
            let far = |m: &&[f32; 3]| m[0] < there - 90.0;
            let of = |c: &GaussianCloud| c.means.iter().filter(far).copied().collect::<Vec<_>>();
            assert_eq!(of(&before), of(&after));
            looked_at += of(&before).len();
        }
    }
    assert!(engine.gaussians() > 3000 && looked_at > 1000, "{} {looked_at}", engine.gaussians());
}

/// Flies `pictures`, trains `share` of a schedule as far as is written down, and lands: what there was in flight, how much of it the
/// landing kept, what there is then, and the progress at which the schedule begins.
fn landed(pictures: &[PosedImage], share: f64) -> Option<(GaussianCloud, usize, GaussianCloud, f32)> {
    let mut engine = engine()?;
    pictures.iter().for_each(|p| _ = take(&mut engine, p.clone()));
    let in_flight = snapshot(&mut engine);
    assert!(!engine.wants_build(false));
    engine.delivery.header.steps = (share * f64::from(engine.training.settings.steps)) as u64;
    engine.land();
    assert!(engine.wants_build(true) && engine.build(&|| false).expect("built") && !engine.wants_build(true));
    assert!(!engine.wants_growth());
    let kept = engine.report.more["gaussians_kept"].as_u64().expect("a number") as usize;
    let progress = engine.training.trainer.schedule().progress();
    Some((in_flight, kept, snapshot(&mut engine), progress))
}

#[test]
fn the_same_flight_twice_is_the_same_bytes_and_the_landing_builds_it_once_more() {
    let pictures: Vec<PosedImage> = flight().into_iter().take(16).collect();
    let Some(first) = landed(&pictures, 0.0) else { return };
    assert!(landed(&pictures, 0.0).as_ref() == Some(&first));
    let (in_flight, _, after, _) = first;
    assert!(after.len() >= in_flight.len() * 9 / 10, "{} {}", after.len(), in_flight.len());
}

#[test]
fn what_was_trained_in_flight_is_where_the_schedule_begins_unless_most_of_it_is_still_ahead() {
    let pictures: Vec<PosedImage> = flight().into_iter().take(16).collect();
    let Some((in_flight, kept, _, progress)) = landed(&pictures, 0.6) else { return };
    assert!(2 * kept > in_flight.len(), "{kept} of {}", in_flight.len());
    assert!(progress > 0.0, "what is trained needs neither the largest rates nor the smallest pictures");
    let Some((_, kept, _, progress)) = landed(&pictures, 0.4) else { return };
    assert_eq!(kept, 0, "depths of all pictures are better than those of the few there were");
    assert_eq!(progress, 0.0, "and begin their schedule");
}
