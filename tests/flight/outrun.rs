//! An aircraft that takes pictures faster than its computer takes them in: what is trained meanwhile.

use std::path::Path;

use config::failsafe::FailsafeSettings;
use config::mission::KeyframeSettings;
use config::upload::UploadSettings;
use disk::Disk;
use engine::PictureSource;
use engine::failsafe::Failsafe;
use glam::{DQuat, DVec3};
use hal::camera::Picture;
use hal::time::ManualClock;
use job::health::Health;
use job::interrupt::Interrupt;
use models::camera::{Pose, PoseSigma, PosedImage, View};
use uplink::Offerer;
use vulkan::trainer::RunBudget;

use super::fault_table::{ORIGIN, usual};
use super::handover::{AHEAD, handover};
use super::onboard::Job;
use super::rehearsal::{Ledger, intrinsics, unsigned};
use crate::keyframe_store::KeyFrame;

/// Steps trained in flight while `turns` key frames are taken in and others always wait.
fn trained_while_others_wait(train_steps: u32, turns: usize) -> u64 {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path();
    let lens = usual().vehicle.lens;
    let (ledger, _) = Ledger::open(&Disk::default(), &lens, ORIGIN, out).expect("opens");
    let limits = FailsafeSettings { disk_low_mib: 0, ..FailsafeSettings::default() };
    let failsafe = Failsafe::new(Health::with_sensors(Path::new("/nonexistent"), limits, 1 << 20, out), &limits);
    let offerer = Offerer::start(&UploadSettings::default(), unsigned("rehearsal", "one")).expect("a thread");
    let budget = RunBudget { steps: Some(10_000), seconds: None };
    let (mut capture, end) = handover();
    let mut job = Job::new(ledger, offerer, out, budget, failsafe, ManualClock::default()).without_waiting();
    job = job.training_for_each(train_steps);
    let pose = Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO };
    let mut names = 0..;
    for _ in 0..turns {
        while capture.waiting() < AHEAD
            && let Some(i) = names.next()
        {
            let posed = PosedImage {
                name: format!("{i}.png"),
                time_ns: 0,
                image: image::RgbImage::new(1, 1),
                view: View { intrinsics: intrinsics(&lens), pose },
                mask: None,
                sigma: PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] },
            };
            let file = Picture::Path(out.join(&posed.name));
            end.count(true);
            assert!(end.frames.try_send(KeyFrame { posed, file }).is_ok());
        }
        assert!(job.turn(&mut capture, &Interrupt::default()).expect("goes on"));
    }
    job.reconstruction_mut().steps_total()
}

#[test]
fn a_flight_that_outruns_its_computer_has_a_trained_model_in_flight_too() {
    let turns = 100;
    // One step a turn is what the ledger takes; three key frames come before the first build.
    assert!(trained_while_others_wait(KeyframeSettings::default().train_steps, turns) > 90);
    assert_eq!(trained_while_others_wait(0, turns), 0, "unless it is told not to");
}
