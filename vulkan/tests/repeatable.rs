//! One seed gives the same bytes whatever number of threads the driver uses and whenever a checkpoint is taken, and a long run needs no more memory
//! than a short one. Both are questions to a whole process, so the test starts itself again as a child.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use models::cloud::GaussianCloud;
use scenes::device::{empty_trainer, plain, posed};
use scenes::{cloud, photo, view};
use std::ops::ControlFlow;
use std::process::Command;
use vulkan::fixture::Fixture;
use vulkan::trainer::RunBudget;

/// Set in the child: what it is to do.
const ROLE: &str = "DGTR_TEST_ROLE";

/// Two views, growth, relocation and noise: everything that draws random numbers.
fn growing(steps: u32) -> Option<Fixture> {
    let v = view(64, 48);
    let mut settings = plain();
    settings.density.strategy = config::training::Strategy::Relocate;
    settings.steps = steps;
    settings.regularise.noise = 2.0;
    settings.regularise.opacity_decay = 0.004;
    let mut trainer = empty_trainer(3, 800, &v, &settings)?;
    trainer.load(&cloud(8, 300, 3)).unwrap();
    for seed in [1, 2] {
        trainer.add_view(&posed(&v, &photo(seed, &v)), None).unwrap();
    }
    Some(trainer)
}

/// FNV-1a over every parameter's bits.
fn hash(trainer: &mut Fixture) -> u64 {
    let mut cloud = GaussianCloud::with_capacity(3, trainer.gaussians());
    trainer.snapshot(&mut cloud).unwrap();
    let all = cloud.means.as_flattened().iter().chain(cloud.log_scales.as_flattened());
    let all = all.chain(cloud.rotations.as_flattened()).chain(&cloud.opacity_logits).chain(&cloud.sh);
    all.fold(0xcbf2_9ce4_8422_2325, |h, v| (h ^ u64::from(v.to_bits())).wrapping_mul(0x100_0000_01b3))
}

/// Runs this binary's test `name` in the given role and returns what it printed behind `=`.
fn child(name: &str, threads: &str, save_at: &str) -> Option<String> {
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", name, "--nocapture"])
        .env(ROLE, "child")
        .env("DGTR_TEST_SAVE_AT", save_at)
        .env("LP_NUM_THREADS", threads) // threads of Mesa's software driver; other drivers do not look at it
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    text.split("answer=").nth(1).map(|rest| rest.split_whitespace().next().unwrap().to_owned())
}

#[test]
fn the_same_seed_gives_the_same_model_with_one_thread_and_with_two() {
    let name = "the_same_seed_gives_the_same_model_with_one_thread_and_with_two";
    if std::env::var_os(ROLE).is_some() {
        let Some(mut trainer) = growing(120) else { return };
        let save_at: usize = std::env::var("DGTR_TEST_SAVE_AT").map_or(0, |at| at.parse().unwrap());
        let mut saved = GaussianCloud::with_capacity(3, 800);
        for step in 0..120 {
            // A checkpoint falls where the clock says.
            if trainer.step().unwrap().settled && step >= save_at && saved.is_empty() {
                trainer.snapshot(&mut saved).unwrap();
            }
        }
        assert!(trainer.gaussians() > 300, "density control did not run");
        println!("answer={:016x}", hash(&mut trainer));
        return;
    }
    let hashes =
        [("0", "10"), ("1", "0"), ("2", "50"), ("2", "119")].map(|(threads, save_at)| child(name, threads, save_at));
    println!("{hashes:?}");
    assert!(hashes.iter().all(|h| *h == hashes[0]), "{hashes:?}");
}

/// Largest resident set so far, KiB.
fn high_water() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmHWM:"));
    line.and_then(|l| l.split_whitespace().nth(1)).and_then(|n| n.parse().ok()).unwrap_or(0)
}

#[test]
fn ten_thousand_steps_need_no_more_memory_than_one_thousand() {
    let name = "ten_thousand_steps_need_no_more_memory_than_one_thousand";
    if std::env::var_os(ROLE).is_some() {
        let Some(mut trainer) = growing(10_000) else { return };
        let mut early = 0;
        let budget = RunBudget { steps: Some(10_000), seconds: None };
        let summary = trainer.run(&budget, &mut |report| {
            if report.step == 1_000 {
                early = high_water();
            }
            ControlFlow::Continue(())
        });
        let counters = summary.unwrap().counters;
        println!("answer={early},{},{},{}", high_water(), trainer.gaussians(), counters.non_finite_gradients);
        return;
    }
    // Without worker threads: to wake them takes longer than these steps.
    let Some(answer) = child(name, "0", "0") else { return };
    println!("KiB after 1,000 and 10,000 steps, Gaussians, non-finite gradients: {answer}");
    let parts: Vec<&str> = answer.split(',').collect();
    let (early, late): (u64, u64) = (parts[0].parse().unwrap(), parts[1].parse().unwrap());
    // Density control goes on until 7,000 steps; its lists and the arena were there from the start.
    assert!(late <= early + 512, "{early} KiB grew to {late} KiB");
    assert_eq!(parts[3], "0", "gradients that were not finite");
}
