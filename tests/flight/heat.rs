//! The failsafe ladder after the landing: the schedule is finished on the ground, and the computer is no cooler there.

use std::cell::Cell;

use config::failsafe::FailsafeSettings;
use config::upload::UploadSettings;
use disk::Disk;
use engine::Reconstruct;
use engine::failsafe::Failsafe;
use glam::{DQuat, DVec3};
use hal::traits::Clock;
use job::health::Health;
use job::interrupt::Interrupt;
use models::camera::{Pose, PoseSigma, PosedImage, View};
use uplink::Offerer;
use vulkan::trainer::RunBudget;

use super::fault_table::{ORIGIN, usual};
use super::handover::handover;
use super::intake::FlightCounters;
use super::onboard::Job;
use super::rehearsal::{Ledger, intrinsics, unsigned};

/// Half a second passes whenever somebody looks.
struct Ticking(Cell<u64>);

impl Clock for Ticking {
    fn now_ns(&self) -> u64 {
        self.0.set(self.0.get() + 500_000_000);
        self.0.get()
    }
}

/// Lands with three key frames on a computer whose hottest zone has this temperature, millidegrees: steps trained, and whether
/// the schedule was finished.
fn land(temperature: &str) -> (u64, bool) {
    let folder = tempfile::tempdir().expect("a folder");
    let (sys, out) = (folder.path().join("sys"), folder.path().join("out"));
    let zone = sys.join("class/thermal/thermal_zone0");
    std::fs::create_dir_all(&zone).expect("a folder");
    std::fs::create_dir_all(&out).expect("a folder");
    std::fs::write(zone.join("temp"), temperature).expect("written");
    let lens = usual().vehicle.lens;
    let (mut ledger, _) = Ledger::open(&Disk::default(), &lens, ORIGIN, &out).expect("opens");
    ledger.landed = true;
    for i in 0..3 {
        let view =
            View { intrinsics: intrinsics(&lens), pose: Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO } };
        let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
        let image = image::RgbImage::new(lens.width, lens.height);
        ledger
            .add(PosedImage { name: format!("{i}.png"), time_ns: 0, image, view, mask: None, sigma }, false)
            .expect("taken");
    }
    let offerer = Offerer::start(&UploadSettings::default(), unsigned("rehearsal", "one")).expect("a thread");
    let limits = FailsafeSettings { disk_low_mib: 0, ..FailsafeSettings::default() };
    let failsafe = Failsafe::new(Health::with_sensors(&sys, limits, 1 << 20, &out), &limits);
    let budget = RunBudget { steps: Some(200), seconds: None };
    let (mut capture, end) = handover();
    drop(end);
    let job = Job::new(ledger, offerer, &out, budget, failsafe, Ticking(Cell::new(0))).without_waiting();
    let end = job.land(&mut capture, &FlightCounters::default(), &Interrupt::default()).expect("lands");
    (end.reconstruction.steps_total(), end.finished)
}

#[test]
fn a_computer_that_is_too_hot_after_the_landing_keeps_a_checkpoint_and_leaves_the_rest() {
    assert_eq!(land("50000"), (200, true));
    let (steps, finished) = land("95000");
    assert!((1..20).contains(&steps) && !finished, "{steps} steps");
}
