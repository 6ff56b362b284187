//! The driver compiles each kernel once. Alone in its file: what other trainers of the same process compile would count.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use glam::{DQuat, DVec3};
use scenes::device::{empty_trainer, plain, posed};
use scenes::{cloud, photo, view};
use vulkan::trainer::Rendering;

/// KiB of executable memory that comes from no file: the driver's compiled kernels.
fn compiled_kib() -> u64 {
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    let bytes = |line: &str| {
        let mut fields = line.split_whitespace();
        let (from, to) = fields.next()?.split_once('-')?;
        let anonymous = fields.next()?.contains('x') && fields.nth(3).is_none();
        let [from, to] = [from, to].map(|end| u64::from_str_radix(end, 16).unwrap());
        anonymous.then_some(to - from)
    };
    maps.lines().filter_map(bytes).sum::<u64>() / 1024
}

/// A software driver that compiles a kernel anew for every camera grows without end, out of sight of our own plan.
#[test]
fn the_driver_compiles_nothing_more_however_many_cameras_are_seen() {
    let v = view(64, 48);
    let Some(mut trainer) = empty_trainer(3, 400, &v, &plain()) else { return };
    trainer.load(&cloud(8, 300, 3)).unwrap();
    for seed in [1, 2] {
        trainer.add_view(&posed(&v, &photo(seed, &v)), None).unwrap();
    }
    let mut drawn = Rendering::default();
    let mut look = |i: u32| {
        let turn = DQuat::from_axis_angle(DVec3::new(0.3, 1.0, 0.2).normalize(), 0.2 + 0.01 * f64::from(i));
        let mut turned = v;
        turned.pose.rotation = turn * v.pose.rotation;
        trainer.pictures.set_pose(0, turned.pose).unwrap();
        trainer.pictures.set_pose(1, turned.pose).unwrap();
        trainer.step().unwrap();
        trainer.render(&turned, &mut drawn).unwrap();
    };
    // The first steps compile every kernel that is needed.
    (0..4).for_each(&mut look);
    let before = compiled_kib();
    (4..54).for_each(&mut look);
    let after = compiled_kib();
    println!("compiled kernels: {before} KiB -> {after} KiB over 50 cameras");
    assert!(after < before + 200, "the driver goes on compiling: {before} KiB -> {after} KiB over 50 cameras");
}
