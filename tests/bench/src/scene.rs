//! A scene that neither the device nor the host holds: out of a file into the trainer's cells, trained, into a file again, and drawn; each
//! picture against one of a trainer that has all of it on the device, where that fits.

use std::path::{Path, PathBuf};
use std::time::Instant;

use config::budget::Memory;
use config::plan::{Lanes, Plan};
use config::training::TrainSettings;
use disk::Disk;
use engine::device::DeviceRequest;
use engine::error::EngineError;
use engine::evaluate::save_png;
use engine::host::{HostPlan, HostRequest};
use engine::{model_path, pieces};
use glam::{DQuat, DVec3};
use job::resources::peak_rss_bytes;
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::{Chunks, ModelHeader};
use models::metrics::to_rgb8;
use serde::Serialize;
use tuning::cost::synthetic::picture;
use vulkan::trainer::{Rendering, RunBudget, Trainer};

use super::frustum::{Frustum, mean, reach};
use super::levels::{SPACING_M, write_scene};
use runtime::error::JobError;

/// Training pictures and pictures drawn, and their focal length, pixels.
const SIZE: [u32; 2] = [640, 480];
const FOCAL: f64 = 512.0;
/// Training pictures along each side of the ground.
const ALONG: u32 = 4;
/// A training picture sees such a share of what the device holds, were the ground as high as its hills.
const SEEN_SHARE: f64 = 0.125;
/// Height of the made-up ground's hills, metres.
const HILLS_M: f64 = 12.0;
/// More than any plan of such pictures takes, MiB: what binds an unpaged one is how much of it a kernel can see at once.
const UNPAGED_MIB: u32 = 1 << 14;
/// The ground is so much narrower than the picture that shows all of it.
const MARGIN: f64 = 1.05;

/// What is measured.
#[derive(Clone, Debug)]
pub struct Request {
    /// Gaussians of the made-up scene.
    pub gaussians: usize,
    /// Their SH degree.
    pub sh_degree: u8,
    /// Steps of training.
    pub steps: u32,
    /// Device memory, MiB.
    pub device_mib: u32,
    /// Part of the device's name.
    pub device: Option<String>,
}

/// A picture of the scene.
#[derive(Clone, Debug, Serialize)]
pub struct Drawn {
    /// Where it lies.
    pub path: PathBuf,
    /// Seconds.
    pub seconds: f64,
    /// Gaussians that may show in it.
    pub seen: usize,
    /// Whether a trainer that has all of those on the device draws the same bits; `None`: no device holds so many.
    pub same: Option<bool>,
}

/// What came of it.
#[derive(Clone, Debug, Serialize)]
pub struct Figures {
    /// Name of the device.
    pub device: String,
    /// The device's memory is the host's.
    pub shared: bool,
    /// Gaussians of the scene, and how many of them the device holds at once.
    pub gaussians: [usize; 2],
    /// Cells of ground, and windows of them that were trained.
    pub cells: [u64; 2],
    /// Bytes of the scene's file, and of cells that went into it and out of it.
    pub file_bytes: [u64; 2],
    /// Bytes of the device, planned and allocated.
    pub device_bytes: [u64; 2],
    /// Bytes of the host, planned: the device's included where that is the host's.
    pub host_bytes_planned: u64,
    /// Largest resident set until everything was trained, saved and drawn.
    pub resident_bytes: u64,
    /// Steps of training.
    pub steps: u32,
    /// Seconds: until the made-up scene was written, it was in its cells, it was trained, it was saved.
    pub seconds: [f64; 4],
    /// From near by, then the whole.
    pub drawn: Vec<Drawn>,
}

/// Trains and draws a made-up scene in `out`.
///
/// # Errors
/// No device, too little memory, a full disk.
pub fn measure(request: &Request, out: &Path) -> Result<Figures, JobError> {
    let (file, model) = (out.join("scene.dgtr"), model_path(out));
    std::fs::create_dir_all(out).map_err(JobError::io(out))?;
    let mut clock = Clock(Instant::now());
    write_scene(&file, request.gaussians, request.sh_degree)?;
    let written = clock.lap();
    let settings = settings(request);
    let gaussians = u32::try_from(request.gaussians).unwrap_or(u32::MAX);
    let wanted = device_request(request, out, (ALONG * ALONG) as usize, Some(gaussians));
    let (mut trainer, mut trained_on): (Trainer, _) = wanted.open::<JobError>(&settings)?;
    pieces::load(&mut trainer, &Chunks::open(&file)?)?;
    let loaded = clock.lap();
    let side = SPACING_M * (request.gaussians as f64).sqrt();
    let [near, whole] = views(side, trainer.plan().gaussians);
    for i in 0..ALONG * ALONG {
        let at = [i % ALONG, i / ALONG].map(|k| side * (f64::from(k) + 0.5) / f64::from(ALONG));
        let center = DVec3::new(at[0], at[1], near.pose.center.z);
        let view = View { pose: Pose { center, ..near.pose }, ..near };
        trained_on.add(trainer.device_mut(), &picture(&view, i.into()), None)?;
    }
    let budget = RunBudget { steps: Some(request.steps), seconds: None };
    let summary = trainer.run(&mut trained_on, &budget, &mut |_| std::ops::ControlFlow::Continue(()))?;
    let trained = clock.lap();
    let header = ModelHeader { mission: "scene".into(), steps: summary.steps.into(), ..ModelHeader::default() };
    let gaussians = pieces::save(&mut trainer, &Disk::default(), &model, &header)?;
    let saved = clock.lap();
    let mut pictures = Vec::new();
    for (name, view) in [("near.png", near), ("whole.png", whole)] {
        let mut rendering = Rendering::default();
        trainer.render(&view, &mut rendering)?;
        let path = out.join(name);
        let shown = to_rgb8(&rendering.rgb, rendering.width, rendering.height);
        save_png(&shown.ok_or_else(|| EngineError::RenderingSize(name.into()))?, &path)?;
        pictures.push((view, rendering, path, clock.lap()));
    }
    let info = trainer.device().gpu().info();
    let (plan, counters) = (trainer.plan(), summary.counters);
    let mut figures = Figures {
        device: info.name.clone(),
        shared: info.is_cpu,
        gaussians: [gaussians, plan.gaussians],
        cells: [trainer.cells().0 as u64, counters.windows],
        file_bytes: [plan.scene_file_bytes(), counters.paged_bytes],
        device_bytes: [plan.total_bytes, trainer.device().bytes()],
        host_bytes_planned: host_plan(&trainer).total_bytes(),
        resident_bytes: peak_rss_bytes().unwrap_or(0),
        steps: summary.steps,
        seconds: [written, loaded, trained, saved],
        drawn: Vec::new(),
    };
    // Two of them would not find room.
    drop(trainer);
    let saved = Chunks::open(&model)?;
    for (view, rendering, path, seconds) in pictures {
        let (seen, same) = compare(request, out, &saved, &view, &rendering)?;
        figures.drawn.push(Drawn { path, seconds, seen, same });
    }
    Ok(figures)
}

/// Seconds since it was looked at last.
struct Clock(Instant);

impl Clock {
    fn lap(&mut self) -> f64 {
        let seconds = self.0.elapsed().as_secs_f64();
        self.0 = Instant::now();
        seconds
    }
}

fn settings(request: &Request) -> TrainSettings {
    let mut settings = TrainSettings { steps: request.steps, ..TrainSettings::default() };
    settings.sh.degree = request.sh_degree;
    settings
}

fn device_request(request: &Request, out: &Path, views: usize, scene_gaussians: Option<u32>) -> DeviceRequest {
    DeviceRequest {
        device: request.device.clone(),
        memory: Memory { device_mib: Some(request.device_mib), scene_gaussians, ..Memory::default() },
        size: SIZE.into(),
        views,
        crops: 0,
        folder: Some(out.to_owned()),
    }
}

fn host_plan(trainer: &Trainer) -> HostPlan {
    HostPlan::new(&HostRequest {
        plan: trainer.plan(),
        on_host: if trainer.device().gpu().info().is_cpu {
            trainer.device().bytes()
        } else {
            trainer.device().mirror_bytes()
        },
        initialiser: 0,
        refine: None,
        refine_in_file: false,
        camera_pixels: u64::from(SIZE[0] * SIZE[1]),
        ahead: 0,
        ahead_in_memory: false,
        delivers: false,
        from_file: trainer.plan().is_paged(),
        map: 0,
    })
}

/// Straight down onto the middle of the ground: from where a picture shows a share of what the device holds, and from where it shows
/// all of it.
fn views(side: f64, on_device: usize) -> [View; 2] {
    let [width, height] = SIZE;
    let [across, down] = SIZE.map(f64::from);
    let half = SIZE.map(|n| n as f32 / 2.0);
    let intrinsics = Intrinsics { width, height, fx: FOCAL as f32, fy: FOCAL as f32, cx: half[0], cy: half[1] };
    let pose = |distance: f64| Pose {
        rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0),
        center: DVec3::new(0.5 * side, 0.5 * side, HILLS_M + distance),
    };
    let shown = (SEEN_SHARE * on_device as f64 * across / down).sqrt() * SPACING_M;
    let whole = MARGIN * side * FOCAL / down;
    [shown * FOCAL / across, whole].map(|distance| View { intrinsics, pose: pose(distance.min(whole)) })
}

/// What of the model may show in a picture, and whether a trainer of that alone, all of it on the device, draws the same bits.
fn compare(
    request: &Request,
    out: &Path,
    model: &Chunks,
    view: &View,
    drawn: &Rendering,
) -> Result<(usize, Option<bool>), JobError> {
    let frustum = Frustum::of(view);
    let each = |take: &mut dyn FnMut(&GaussianCloud) -> Result<(), JobError>| {
        let each = model.each::<JobError>(&mut |piece| {
            let in_view = |i: &u32| frustum.meets(mean(piece, *i as usize), reach(piece, *i as usize));
            take(&piece.rows(&(0..piece.len() as u32).filter(in_view).collect::<Vec<_>>()))
        });
        each.map(drop)
    };
    let mut seen = 0;
    each(&mut |piece| {
        seen += piece.len();
        Ok(())
    })?;
    // As much of the device as it takes: the paged one is what is bounded.
    let wanted =
        DeviceRequest { memory: Memory::for_gaussians(UNPAGED_MIB, seen), ..device_request(request, out, 1, None) };
    let settings = settings(request);
    if seen == 0 || Plan::new(&wanted.plan_request(&settings.sh, Lanes::CARD))?.gaussians < seen {
        return Ok((seen, None));
    }
    let (mut trainer, _): (Trainer, _) = wanted.open::<JobError>(&settings)?;
    trainer.load_pieces(&each)?;
    let mut unpaged = Rendering::default();
    trainer.render(view, &mut unpaged)?;
    let bits = |r: &Rendering| -> Vec<u32> {
        r.rgb.iter().chain(&r.depth).chain(&r.transmittance).map(|v| v.to_bits()).collect()
    };
    Ok((seen, Some(trainer.cells().0 == 0 && bits(&unpaged) == bits(drawn))))
}
