//! Trains a data set from its sparse points and reports time per stage and held-out PSNR:
//! `cargo run --release -p vulkan --example fit -- DATASET [steps] [max_gaussians] [growth]`
use config::plan::{Plan, PlanRequest};
use config::training::{Strategy, TrainSettings};
use std::ops::ControlFlow;
use std::path::Path;
use survey::dataset::Dataset;
use vulkan::gpu::Gpu;
use vulkan::trainer::{PictureStore, Rendering, RunBudget, Trainer};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().collect();
    let number = |i: usize, or: usize| args.get(i).and_then(|a| a.parse().ok()).unwrap_or(or);
    let (steps, capacity) = (number(2, 50), number(3, 12_000));
    let dataset = Dataset::open(Path::new(args.get(1).ok_or("which data set?")?))?;
    let (train, test) = (dataset.select("train", None)?, dataset.select("test", None)?);
    let first = dataset.load(train[0], 1.0)?;
    let request = PlanRequest {
        device_mib: 2048,
        width: first.image.width(),
        height: first.image.height(),
        views: train.len() as u32,
        sh_degree: 3,
        max_gaussians: Some(capacity),
        scene_gaussians: None,
        ..Default::default()
    };
    let plan = Plan::new(&request)?;
    let mut settings = TrainSettings { steps: steps as u32, ..TrainSettings::default() };
    settings.density.strategy = if number(4, 0) > 0 { Strategy::Relocate } else { Strategy::None };
    settings.resolution.half_until = number(5, 0) as f32 * 0.01;
    let gpu = Gpu::open(std::env::var("DGTR_DEVICE").ok().as_deref())?;
    println!("{:?}: N {} M {} bytes {}", gpu.info(), plan.gaussians, plan.instances, plan.total_bytes);
    let mut trainer = Trainer::new(&gpu, &plan, &settings)?;
    let mut pictures = PictureStore::new(&plan);
    let points = dataset.sparse_points()?;
    let positions: Vec<[f32; 3]> = points.iter().map(|p| p.position.map(|v| v as f32)).collect();
    let colours: Vec<[u8; 3]> = points.iter().map(|p| p.color).collect();
    let cloud = models::init::from_sfm(&positions, &colours, capacity)?;
    println!("{:?}", trainer.load(&cloud)?);
    for i in &train {
        pictures.add(trainer.device_mut(), &dataset.load(*i, 1.0)?, None)?;
    }
    let before = cpu_seconds();
    let summary = trainer.run(&mut pictures, &RunBudget { steps: Some(steps as u32), seconds: None }, &mut |r| {
        if r.step % (steps as u32 / 10).max(1) == 0 || r.step == 1 {
            println!(
                "{} loss {:.4} l1 {:.4} ssim {:.4} visible {} of {} instances {} bands {}",
                r.step, r.loss, r.l1, r.ssim, r.visible, r.gaussians, r.instances, r.bands
            );
        }
        ControlFlow::Continue(())
    })?;
    let n = f64::from(summary.steps);
    let cpu = cpu_seconds() - before;
    println!("{summary:?}\nwall {:.1} ms/step, cpu {:.1} ms/step", summary.seconds * 1e3 / n, cpu * 1e3 / n);
    let c = summary.counters;
    println!("per step: instances {:.0} evaluations {:.2} M", c.instances as f64 / n, c.evaluations as f64 / n * 1e-6);
    for (name, ms) in trainer.device().stage_ms() {
        println!("{name:>20} {:8.2} ms", ms / n);
    }
    let mut rendering = Rendering::default();
    let mut sum = 0.0;
    for i in &test {
        let picture = dataset.load(*i, 1.0)?;
        trainer.render(&picture.view, &mut rendering)?;
        let mse: f64 = rendering
            .rgb
            .iter()
            .zip(picture.image.as_raw())
            .map(|(a, b)| (f64::from(a.clamp(0.0, 1.0)) - f64::from(*b) / 255.0).powi(2))
            .sum::<f64>()
            / rendering.rgb.len() as f64;
        sum += -10.0 * mse.log10();
    }
    println!("held-out PSNR {:.3} dB over {} views", sum / test.len() as f64, test.len());
    let mut cloud = cloud;
    trainer.snapshot(&mut cloud)?;
    let bits = cloud
        .means
        .as_flattened()
        .iter()
        .chain(&cloud.sh)
        .fold(0u64, |h, v| (h ^ u64::from(v.to_bits())).wrapping_mul(0x100_0000_01b3));
    println!("hash {bits:016x}");
    Ok(())
}

fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    fields.get(11).and_then(|t| t.parse::<f64>().ok()).unwrap_or(0.0) / 100.0
}
