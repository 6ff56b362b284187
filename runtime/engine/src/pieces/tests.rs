use std::ops::ControlFlow;

use models::formats::model::ModelHeader;
use vulkan::gpu::Gpu;
use vulkan::trainer::RunBudget;

use super::*;
use crate::testing::{picture, settings};
use crate::{EngineSettings, InitKind, Reconstruct, Reconstruction};

/// Of 300 Gaussians so many are on the device at once.
fn engine(on_device: u32, start: InitKind) -> Reconstruction {
    let mut settings = EngineSettings { start, ..settings() };
    let memory = &mut settings.device.memory;
    (memory.max_gaussians, memory.scene_gaussians) = (Some(on_device), Some(300));
    Reconstruction::open(settings, ModelHeader::default(), "train").expect("opens")
}

fn take(engine: &mut Reconstruction) {
    for i in 0..3 {
        engine.add(picture(i), i < 2).expect("taken");
    }
    assert!(engine.build(&|| false).expect("built"));
}

/// Looks at so many pictures, in parts.
fn train(engine: &mut Reconstruction, steps: u32) {
    let budget = RunBudget { steps: Some(engine.training.trainer.schedule().spent().0 + steps), seconds: None };
    engine.train(&budget, &mut |_| ControlFlow::Continue(())).expect("trains");
}

fn trained(engine: &mut Reconstruction) -> GaussianCloud {
    let mut cloud = GaussianCloud::default();
    engine.training.trainer.snapshot(&mut cloud).expect("read");
    cloud
}

/// Cells are chosen anew for what is loaded, and have an order of their own.
fn sorted(cloud: &GaussianCloud) -> GaussianCloud {
    let mut rows: Vec<u32> = (0..cloud.len() as u32).collect();
    rows.sort_by_key(|i| cloud.means[*i as usize].map(f32::to_bits));
    cloud.rows(&rows)
}

fn has_device() -> bool {
    let found = Gpu::list().is_ok();
    if !found {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
    }
    found
}

#[test]
fn a_checkpoint_in_pieces_is_the_file_of_the_whole_and_is_continued_as_it_was() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().expect("folder");
    let mut first = engine(120, InitKind::Random);
    take(&mut first);
    assert!(first.training.in_pieces && first.training.cloud.is_empty());
    train(&mut first, 5);
    let (path, gaussians) = first.checkpoint(dir.path(), false).expect("written");
    let cloud = trained(&mut first);
    assert_eq!((cloud.len(), cloud.sh_degree), (gaussians, 3));
    let whole = dir.path().join("whole.dgtr");
    model::write_checkpoint(&Disk::default(), &whole, first.header(), &cloud).expect("written");
    let [a, b] = [&path, &whole].map(|path| std::fs::read(path).expect("read"));
    assert!(a == b, "the files differ");
    assert_eq!(first.means(usize::MAX).expect("read"), cloud.means);
    let every: Vec<[f32; 3]> = cloud.means.iter().copied().step_by(gaussians.div_ceil(50)).collect();
    assert_eq!(first.means(50).expect("read"), every);

    let mut second = engine(120, InitKind::Random);
    assert_eq!(second.resume(dir.path()).expect("read").map(|views| views.len()), Some(3));
    take(&mut second);
    assert!(sorted(&trained(&mut second)) == sorted(&cloud), "other Gaussians than were saved");
    assert_eq!(second.training.trainer.schedule().spent().0, 5);
    let mut third = engine(120, InitKind::Model);
    third.begin_with(Chunks::open(&path).expect("a model"));
    take(&mut third);
    assert!(
        sorted(&trained(&mut third)) == sorted(&cloud) && third.training.trainer.schedule().spent().0 == 0,
        "a schedule of its own"
    );
    train(&mut third, 3);
}

#[test]
fn giving_up_gaussians_of_a_scene_in_pieces_leaves_none_of_it_in_memory() {
    if !has_device() {
        return;
    }
    let mut engine = engine(120, InitKind::Random);
    take(&mut engine);
    train(&mut engine, 4);
    let before = engine.gaussians();
    engine.shrink().expect("the device works");
    assert!(engine.gaussians() < before && engine.training.cloud.is_empty());
    train(&mut engine, 2);
}

#[test]
fn a_model_that_fails_on_its_way_out_leaves_the_one_saved_before() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().expect("folder");
    let mut engine = engine(120, InitKind::Random);
    take(&mut engine);
    let (path, _) = engine.checkpoint(dir.path(), false).expect("written");
    let before = std::fs::read(&path).expect("read");
    // The cells cannot be read any more.
    engine
        .training
        .trainer
        .keep_scene_in(std::fs::File::options().read(true).write(true).open("/dev/null").expect("opens"));
    let error = engine.checkpoint(dir.path(), false).expect_err("nothing to read");
    assert!(matches!(error, EngineError::Train(TrainError::SceneFile(_))), "{error}");
    assert!(!error.to_string().contains('\n'), "{error}");
    assert!(std::fs::read(&path).expect("read") == before);
    let names = std::fs::read_dir(dir.path()).expect("folder").flatten().map(|e| e.file_name());
    assert_eq!(names.collect::<Vec<_>>(), ["model.dgtr"], "nothing half written is left");
}

#[test]
fn a_damaged_or_short_model_is_one_line_and_what_is_there_stays() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().expect("folder");
    let mut first = engine(120, InitKind::Random);
    take(&mut first);
    let (path, _) = first.checkpoint(dir.path(), false).expect("written");
    let before = trained(&mut first);
    let whole = std::fs::read(&path).expect("read");
    let bad = dir.path().join("bad.dgtr");
    let mut garbled = whole.clone();
    garbled[whole.len() / 2] ^= 1;
    for bytes in [&garbled[..], &whole[..whole.len() - 100], &whole[..20]] {
        std::fs::write(&bad, bytes).expect("written");
        let error = Chunks::open(&bad).expect_err("damaged").to_string();
        assert!(error.contains("bad.dgtr") && !error.contains('\n'), "{error}");
    }
    // Cut short after it was opened.
    std::fs::write(&bad, &whole).expect("written");
    let opened = Chunks::open(&bad).expect("a model");
    std::fs::write(&bad, &whole[..whole.len() / 2]).expect("written");
    let mut trainer = engine(120, InitKind::Model).training.trainer;
    trainer.load(&before).expect("loaded");
    let error = load(&mut trainer, &opened).expect_err("short").to_string();
    assert!(error.contains("bad.dgtr") && !error.contains('\n'), "{error}");
    let mut kept = GaussianCloud::default();
    trainer.snapshot(&mut kept).expect("read");
    assert!(kept == before, "what the trainer had is there: the file failed before it was begun with");
    // The older generation takes the place of a damaged one.
    first.checkpoint(dir.path(), false).expect("written");
    std::fs::write(&path, &garbled).expect("written");
    let mut second = engine(120, InitKind::Random);
    assert!(second.resume(dir.path()).expect("set aside").is_some());
    take(&mut second);
    assert!(trained(&mut second) == before);
}

#[test]
fn what_flipped_bits_leave_is_mended_in_checkpoints_written_and_in_models_read() {
    if !has_device() {
        return;
    }
    let longest = |cloud: &GaussianCloud| cloud.log_scales.iter().flatten().copied().fold(f32::NEG_INFINITY, f32::max);
    // In pieces and as a whole.
    for on_device in [120, 300] {
        let dir = tempfile::tempdir().expect("folder");
        let mut first = engine(on_device, InitKind::Random);
        take(&mut first);
        assert_eq!(first.training.in_pieces, on_device == 120);
        let sound = trained(&mut first);
        let mut flipped = sound.clone();
        flipped.log_scales[3][1] = 80.0;
        first.training.trainer.load(&flipped).expect("loaded");
        let (path, _) = first.checkpoint(dir.path(), false).expect("written");
        let written = model::read(&path).expect("read").1;
        assert_eq!((written.len(), longest(&written)), (sound.len(), longest(&sound)));
        // One that nobody mended.
        model::write_checkpoint(&Disk::default(), &path, first.header(), &flipped).expect("written");
        let mut second = engine(on_device, InitKind::Random);
        second.resume(dir.path()).expect("read");
        take(&mut second);
        assert_eq!(longest(&trained(&mut second)), longest(&sound));
    }
}
