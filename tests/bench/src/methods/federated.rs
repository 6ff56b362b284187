//! Merging as Fed3DGS does it (Suzuki 2024): the global model is all Gaussians of all clients; where clients overlap none is trusted at
//! first, and distillation changes opacities alone, so that what is seen twice fades on one side, and after its first pass makes them decide (entropy). Then what is transparent goes.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use config::budget::Memory;
use config::training::{LossSettings, RateSettings, Strategy, TrainSettings};
use engine::device::DeviceRequest;
use engine::error::EngineError;
use models::camera::{Intrinsics, PoseSigma, PosedImage, View};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use models::metrics::to_rgb8;
use vulkan::trainer::{Rendering, RunBudget, StopReason, Trainer};

use runtime::error::JobError;

/// Rate of the opacity logits.
const RATE: f32 = 0.05;
/// Passes over all clients' views.
const EPOCHS: u32 = 5;
/// Weight of the opacities' mean entropy, after the first pass (the authors' `build_global_model.py`).
const ENTROPY: f32 = 0.01;
/// Size of the pictures that are learnt from.
const SCALE: f32 = 0.25;
/// Opacity at most where clients overlap, before distillation.
const DOUBTED: f32 = 0.05;
/// Opacity at which a Gaussian goes, after it.
const TRANSPARENT: f32 = 0.005;
/// Side of the squares of ground in which overlap is looked for, metres.
const SQUARE_M: f32 = 4.0;
/// A client has a square when it has this share of the Gaussians of the client with most there.
const HAS_SHARE: f64 = 0.1;

/// How the trainer is asked for.
#[derive(Clone, Debug)]
pub struct Ground {
    /// Part of the device's name.
    pub device: Option<String>,
    /// Device memory, MiB.
    pub device_mib: u32,
    /// Seed of the order of views.
    pub seed: u64,
}

/// The trainer's recipe: its loss without depth, and opacities that move alone.
fn recipe(seed: u64, sh_degree: u8) -> TrainSettings {
    let mut t = TrainSettings { seed, ..TrainSettings::default() };
    t.rates = RateSettings {
        mean_start: 0.0,
        mean_end: 0.0,
        log_scale: 0.0,
        rotation: 0.0,
        opacity: RATE,
        sh_dc: 0.0,
        sh_rest: 0.0,
        final_share: 1.0,
        ..RateSettings::default()
    };
    (t.loss.depth, t.loss.view_dependence) = (0.0, 0.0);
    t.density.strategy = Strategy::None;
    (t.regularise.noise, t.regularise.opacity_decay) = (0.0, 0.0);
    (t.resolution.quarter_until, t.resolution.half_until) = (0.0, 0.0);
    (t.sh.degree, t.sh.raise_at) = (sh_degree, [0.0; 3]);
    t
}

/// Merges the clients' models into `path`; its number of Gaussians, or `None` when `cancelled` said so.
///
/// # Errors
/// A model cannot be read or the result not be written; the device fails.
pub fn merge(
    clients: &[PathBuf],
    ground: &Ground,
    path: &Path,
    cancelled: &dyn Fn() -> bool,
) -> Result<Option<usize>, JobError> {
    let clients: Vec<(ModelHeader, GaussianCloud)> =
        clients.iter().map(|p| model::read(p)).collect::<Result<_, _>>()?;
    let degree = clients.iter().map(|c| c.1.sh_degree).max().unwrap_or(0);
    let mut all = GaussianCloud::with_capacity(degree, clients.iter().map(|c| c.1.len()).sum());
    let mut owner: Vec<usize> = Vec::new();
    for (i, (_, cloud)) in clients.iter().enumerate() {
        all.extend(cloud);
        owner.resize(all.len(), i);
    }
    doubt(&mut all, &owner, clients.len());
    let views: Vec<(usize, &str, View)> = clients
        .iter()
        .enumerate()
        .flat_map(|(i, (header, _))| header.views.iter().map(move |(name, view)| (i, name.as_str(), reduced(view))))
        .collect();
    let side = |of: fn(&Intrinsics) -> u32| views.iter().map(|v| of(&v.2.intrinsics)).max().unwrap_or(1);
    let request = DeviceRequest {
        device: ground.device.clone(),
        memory: Memory { view_slots: Some(views.len() as u32), ..Memory::for_gaussians(ground.device_mib, all.len()) },
        size: (side(|k| k.width), side(|k| k.height)),
        views: views.len(),
        crops: 0,
        folder: None,
    };
    let recipe = recipe(ground.seed, degree);
    let (mut trainer, mut pictures): (Trainer, _) = request.open::<JobError>(&recipe)?;
    let mut lessons = Vec::with_capacity(views.len());
    let mut drawn = Rendering::default();
    for (i, (_, cloud)) in clients.iter().enumerate() {
        trainer.load(cloud)?;
        for (_, name, view) in views.iter().filter(|v| v.0 == i) {
            trainer.render(view, &mut drawn)?;
            let Some(image) = to_rgb8(&drawn.rgb, drawn.width, drawn.height) else {
                return Err(EngineError::RenderingSize((*name).to_owned()).into());
            };
            let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
            // Two clients' pictures may have one name.
            lessons.push(PosedImage { name: format!("{i}/{name}"), time_ns: 0, image, mask: None, view: *view, sigma });
        }
    }
    trainer.load(&all)?;
    for lesson in &lessons {
        pictures.add(trainer.device_mut(), lesson, None)?;
    }
    let mut each = |_: &_| if cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    let pass = lessons.len() as u32;
    for (until, entropy) in [(pass, 0.0), (EPOCHS * pass, ENTROPY)] {
        trainer.set_loss(&LossSettings { entropy, ..recipe.loss })?;
        let run = trainer.run(&mut pictures, &RunBudget { steps: Some(until), seconds: None }, &mut each)?;
        if run.reason == StopReason::Caller {
            return Ok(None);
        }
    }
    trainer.snapshot(&mut all)?;
    let opacities: Vec<f32> = all.opacity_logits.iter().map(|l| 1.0 / (1.0 + (-l).exp())).collect();
    all.retain(|i| opacities[i] > TRANSPARENT);
    let header = ModelHeader {
        aircraft: "global".into(),
        origin: clients.first().and_then(|c| c.0.origin),
        views: clients.iter().flat_map(|c| c.0.views.clone()).collect(),
        steps: trainer.schedule().taken().into(),
        seed: ground.seed,
        finished: true,
        ..ModelHeader::default()
    };
    model::write(path, &header, &all)?;
    Ok(Some(all.len()))
}

/// A view at the size that is learnt from.
fn reduced(view: &View) -> View {
    let k = &view.intrinsics;
    let side = |n: u32| ((n as f32 * SCALE).round() as u32).max(1);
    View { intrinsics: k.resized(side(k.width), side(k.height)), pose: view.pose }
}

/// Lowers the opacities where several clients have the ground.
fn doubt(cloud: &mut GaussianCloud, owner: &[usize], clients: usize) {
    let square = |mean: &[f32; 3]| [mean[0], mean[1]].map(|v| (v / SQUARE_M).floor() as i32);
    let mut counts: HashMap<[i32; 2], Vec<u32>> = HashMap::new();
    for (mean, &client) in cloud.means.iter().zip(owner) {
        counts.entry(square(mean)).or_insert_with(|| vec![0; clients])[client] += 1;
    }
    let shared = |counts: &Vec<u32>| {
        let least = HAS_SHARE * f64::from(counts.iter().copied().max().unwrap_or(0));
        counts.iter().filter(|n| **n > 0 && f64::from(**n) >= least).count() > 1
    };
    let most = (DOUBTED / (1.0 - DOUBTED)).ln();
    for (mean, logit) in cloud.means.iter().zip(&mut cloud.opacity_logits) {
        if counts.get(&square(mean)).is_some_and(shared) {
            *logit = logit.min(most);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::carpet::{carpet, nadir};
    use ground::LocalModel;

    #[test]
    fn opacities_are_doubted_only_where_two_clients_have_the_ground() {
        let mut all = carpet([0.0, 0.0], [40.0, 8.0], 1.0);
        let first = all.len();
        // The second client has the eastern half, and a stray far in the west.
        all.extend(&carpet([20.0, 0.0], [60.0, 8.0], 1.0));
        let row = all.rows(&[0]);
        all.extend(&row);
        let owner: Vec<usize> = (0..all.len()).map(|i| usize::from(i >= first)).collect();
        let before = all.opacity_logits.clone();
        doubt(&mut all, &owner, 2);
        for (i, mean) in all.means.iter().enumerate() {
            let shared = mean[0] > 20.0 && mean[0] < 40.0;
            let opacity = 1.0 / (1.0 + (-all.opacity_logits[i]).exp());
            assert!(if shared { opacity < 0.0501 } else { all.opacity_logits[i] == before[i] }, "{mean:?}: {opacity}");
        }
    }

    #[test]
    fn only_opacities_differ_after_merging_and_what_both_saw_is_opaque_again() {
        if vulkan::gpu::Gpu::list().is_err() {
            return needs::missing(needs::Need::Vulkan, "no Vulkan device");
        }
        let dir = tempfile::tempdir().expect("temp dir");
        let mut clients = Vec::new();
        for (i, x) in [0.0, 10.0].into_iter().enumerate() {
            let header = model::ModelHeader { aircraft: i.to_string(), ..Default::default() };
            let cloud = carpet([x, 0.0], [x + 20.0, 20.0], 1.0);
            let mut client = LocalModel { path: header.aircraft.clone().into(), header, cloud, content: [0; 32] };
            let at = |k: usize| x + 5.0 + 5.0 * (k % 3) as f64;
            client.header.views = (0..3).map(|k| (format!("{k}.png"), nadir(at(k), 10.0, 20.0))).collect();
            let path = dir.path().join(format!("{i}.dgtr"));
            model::write(&path, &client.header, &client.cloud).expect("written");
            clients.push(path);
        }
        let ground = Ground { device: None, device_mib: 64, seed: 1 };
        let path = dir.path().join("global.dgtr");
        assert_eq!(merge(&clients, &ground, &path, &|| true).expect("merges"), None, "stopped");
        assert!(!path.is_file());
        let kept = merge(&clients, &ground, &path, &|| false).expect("merges").expect("to its end");
        let (header, global) = model::read(&path).expect("read");
        assert_eq!((global.len(), header.views.len(), header.steps), (kept, 6, 30));
        let all: Vec<GaussianCloud> = clients.iter().map(|c| model::read(c).expect("read").1).collect();
        let same = |i: usize, of: &GaussianCloud, j: usize| {
            global.means[i] == of.means[j]
                && global.log_scales[i] == of.log_scales[j]
                && global.rotations[i] == of.rotations[j]
        };
        for i in 0..global.len() {
            assert!(all.iter().any(|c| (0..c.len()).any(|j| same(i, c, j))), "{:?} is nobody's", global.means[i]);
        }
        let shared = (0..global.len()).filter(|i| (12.0..18.0).contains(&global.means[*i][0]));
        let most = shared.map(|i| global.opacity_logits[i]).fold(f32::NEG_INFINITY, f32::max);
        assert!(most > -2.5, "the most opaque of those in doubt: {most}");
    }
}
