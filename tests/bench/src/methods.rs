//! The field's methods beside ours: presets of the same trainer on the same pictures, poses, steps or seconds, Gaussians, memory and
//! seed, so that only the method differs. What one aircraft has, a model on the ground has as many times as there are aircraft.

pub mod data;
pub mod federated;
pub mod presets;
pub mod score;
pub mod survey;
pub mod table;
pub mod territory;
pub mod training;
pub mod visibility;

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use ::survey::dataset::{Dataset, SparsePoint, scaled};
use config::error::{Error, ErrorKind};
use config::ground::GroundSettings;
use engine::device::renderer;
use engine::evaluate::{IntoModel, evaluate, open_metric};
use ground::jobs::aggregate;
use ground::member::Member;
use ground::{AggregateError, LocalModel};
use models::formats::{model, read_bounded};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use data::Written;
use presets::{Merge, Method, Pictures};
use runtime::error::JobError;
use runtime::figures::write_json;
use score::Quality;
use territory::Territory;
use training::{Trained, Training};

/// Regions of a data set that has none, unless a number is asked for.
pub const USUAL_REGIONS: usize = 4;
/// A result has a few KiB.
const LIMIT: u64 = 16 << 20;

/// Manifests of the user's own networks.
#[derive(Clone, Debug, clap::Args)]
pub struct Networks {
    /// Manifest of your own pair network.
    #[arg(long = "model", value_name = "MANIFEST")]
    pub pair: Option<PathBuf>,
    /// Manifest of your own depth network for the depth loss [default: the pair network's depth].
    #[arg(long, value_name = "MANIFEST")]
    pub depth: Option<PathBuf>,
    /// Also measure a perceptual distance: manifest of a network of contract `metric`.
    #[arg(long, value_name = "MANIFEST")]
    pub metric: Option<PathBuf>,
}

/// Device and memory of each aircraft.
#[derive(Clone, Debug, clap::Args)]
pub struct Onboard {
    /// Gaussians of each aircraft at most.
    #[arg(long, default_value_t = 60_000, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=100_000_000))]
    pub max_gaussians: usize,
    /// Device memory of each aircraft, MiB.
    #[arg(long, default_value_t = 512)]
    pub budget_mib: u32,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
}

/// What to compare, and what all methods share.
#[derive(Clone, Debug)]
pub struct Request {
    /// Data set.
    pub data: PathBuf,
    /// Folder of everything written.
    pub out: PathBuf,
    /// The list of training pictures.
    pub split: String,
    /// Regions; `None`: the data set's own, or [`USUAL_REGIONS`].
    pub regions: Option<usize>,
    /// Steps of each aircraft.
    pub steps: Option<u32>,
    /// Seconds of each aircraft.
    pub seconds: Option<f64>,
    /// Device and memory of each aircraft.
    pub onboard: Onboard,
    /// Size of the pictures, above 0 and at most 1, in training and in the comparison.
    pub scale: f64,
    /// Seed of everything random.
    pub seed: u64,
    /// The methods, in this order.
    pub methods: Vec<&'static Method>,
    /// The user's own networks.
    pub networks: Networks,
    /// Whether what is in `out` already is done again.
    pub again: bool,
}

/// One method's figures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodResult {
    /// Name.
    pub method: String,
    /// All that decided the figures: while it is the same they are not made again.
    pub plan: Value,
    /// Held-out quality.
    pub quality: Quality,
    /// Seconds of each aircraft, from its first picture to its model; none where the ground trains.
    pub onboard_s: Vec<f64>,
    /// Seconds of the ground.
    pub ground_s: f64,
    /// Bytes that left the aircraft: exact models, or pictures.
    pub sent_bytes: u64,
    /// Bytes that left the aircraft with models in the delivery encoding.
    pub delivery_bytes: u64,
    /// Pictures that left the aircraft that took them.
    pub pictures_sent: usize,
    /// Gaussians of the model that was compared.
    pub gaussians: usize,
    /// Steps of all trainings.
    pub steps: u64,
}

/// Everything that was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Comparison {
    /// Name of the data set.
    pub dataset: String,
    /// Names of the regions, with their training pictures and those held out.
    pub regions: Vec<(String, usize, usize)>,
    /// Steps of each aircraft.
    pub steps: Option<u32>,
    /// Seconds of each aircraft.
    pub seconds: Option<f64>,
    /// Gaussians of each aircraft at most.
    pub max_gaussians: usize,
    /// Size of the pictures.
    pub scale: f64,
    /// Seed.
    pub seed: u64,
    /// One row per method.
    pub methods: Vec<MethodResult>,
}

/// What is read once for all methods.
struct Field<'a> {
    request: &'a Request,
    territories: Vec<Territory>,
    seen: Vec<Vec<usize>>,
    data: Written,
    held_out: Vec<usize>,
    ground_m: f64,
}

/// Measures every method, `each` after every one.
///
/// # Errors
/// Pictures or settings that do not fit together, no device, a training that fails, or stopped on request; what was finished is
/// not done again.
pub fn measure(
    request: &Request,
    cancelled: &dyn Fn() -> bool,
    each: &mut dyn FnMut(&MethodResult),
) -> Result<Comparison, JobError> {
    let field = Field::open(request)?;
    let mut methods = Vec::with_capacity(request.methods.len());
    for method in &request.methods {
        let result = field.measure(method, cancelled)?;
        each(&result);
        methods.push(result);
    }
    let name =
        std::path::absolute(&request.data).ok().and_then(|p| Some(p.file_name()?.to_string_lossy().into_owned()));
    let regions = field.territories.iter().map(|t| (t.name.clone(), t.own.len(), t.held_out.len())).collect();
    Ok(Comparison {
        dataset: name.unwrap_or_else(|| "data".to_owned()),
        regions,
        steps: request.steps,
        seconds: request.seconds,
        max_gaussians: request.onboard.max_gaussians,
        scale: request.scale,
        seed: request.seed,
        methods,
    })
}

impl<'a> Field<'a> {
    fn open(request: &'a Request) -> Result<Self, JobError> {
        let set = Dataset::open(&request.data)?;
        let refused = |what: String| JobError::Request(format!("{}: {what}", set.root.display()));
        if set.card.is_some() {
            let what = "is a camera's card; poses must be settled for all methods alike: export what `dgtr train` made of it \
                        (dgtr export --to nerfstudio)";
            return Err(refused(what.into()));
        }
        let territories = territory::divide(&set, &request.split, request.regions, USUAL_REGIONS)?;
        let points = set.sparse_points()?;
        if let Some(method) = request.methods.iter().find(|m| m.needs_points() && points.is_empty()) {
            let what =
                "has no sparse points (a COLMAP model or an OpenDroneMap reconstruction); leave it out of --methods";
            return Err(refused(format!("{what}: {} begins with them", method.name)));
        }
        let seen = visibility::seen(&set, &territories, &points);
        let data = data::write(&request.out.join("data"), &set, &territories, &seen, &points)?;
        let mut held_out: Vec<usize> = territories.iter().flat_map(|t| t.held_out.iter().copied()).collect();
        held_out.sort_unstable();
        Ok(Self { request, territories, seen, data, held_out, ground_m: ground_height(&points) })
    }

    fn trainings(&self, method: &Method) -> Vec<Training> {
        if method.pictures == Pictures::All {
            return vec![Training::of(method, None, self.territories.len() as u32, self.request, &self.data)];
        }
        let of = |t: &Territory| Training::of(method, Some(&t.name), 1, self.request, &self.data);
        self.territories.iter().map(of).collect()
    }

    /// Figures of a method, from before where all that decides them is the same.
    fn measure(&self, method: &Method, cancelled: &dyn Fn() -> bool) -> Result<MethodResult, JobError> {
        let request = self.request;
        let (trainings, folder) = (self.trainings(method), request.out.join(method.name));
        let kept = folder.join("result.json");
        let ground = self.ground_settings(method)?;
        let plan = json!({
            "trainings": trainings.iter().map(Training::key).collect::<Vec<_>>(),
            "merge": format!("{:?}", method.merge),
            "ground": ground,
            "metric": request.networks.metric,
        });
        if let Some(result) = earlier(&kept).filter(|r| r.plan == plan && !request.again) {
            tracing::info!("{}: measured before ({})", method.name, kept.display());
            return Ok(result);
        }
        let mut trained = Vec::with_capacity(trainings.len());
        for training in &trainings {
            tracing::info!("{}: training in {}", training.name, training.folder.display());
            trained.push(training.run(&self.data, request.again)?);
        }
        let from = Instant::now();
        let path = folder.join("global.dgtr");
        let global = match (&method.merge, &ground) {
            (Merge::ByRegion(_), Some(ground)) => by_region(method, &trained, ground, &folder, cancelled)?,
            (Merge::Opacities, Some(ground)) => {
                let clients: Vec<PathBuf> = trained.iter().map(|t| t.model.clone()).collect();
                let ground = federated::Ground {
                    device: ground.device.clone(),
                    device_mib: ground.device_mib,
                    seed: ground.seed,
                };
                federated::merge(&clients, &ground, &path, cancelled)?.ok_or_else(stopped)?;
                path
            }
            _ => trained.first().map(|t| t.model.clone()).unwrap_or(path),
        };
        let merging_s = from.elapsed().as_secs_f64();
        let (quality, gaussians) = self.score(&global)?;
        let onboard: Vec<f64> = trained.iter().map(|t| t.report.wall_s).collect();
        let central = method.pictures == Pictures::All;
        let (pictures_sent, picture_bytes) = self.exchanged(method)?;
        let models = |bytes: fn(&Trained) -> u64| if central { 0 } else { trained.iter().map(bytes).sum::<u64>() };
        let result = MethodResult {
            method: method.name.to_owned(),
            plan,
            quality,
            ground_s: if central { onboard.iter().sum() } else { merging_s },
            onboard_s: if central { Vec::new() } else { onboard },
            sent_bytes: picture_bytes + models(|t| t.bytes),
            delivery_bytes: picture_bytes + models(|t| t.delivery_bytes),
            pictures_sent,
            gaussians,
            steps: trained.iter().map(|t| t.report.steps).sum(),
        };
        write_json(&kept, &result)?;
        Ok(result)
    }

    /// What the ground works with: what all aircraft have together, and poses as they are. `None` where nothing is merged.
    fn ground_settings(&self, method: &Method) -> Result<Option<GroundSettings>, JobError> {
        let text = match method.merge {
            Merge::None => return Ok(None),
            Merge::ByRegion(text) => text,
            Merge::Opacities => "",
        };
        let mut ground: GroundSettings =
            config::settings::parse(text).map_err(|e| JobError::Request(format!("{}: {e}", method.name)))?;
        let aircraft = self.territories.len();
        ground.register = false;
        ground.device.clone_from(&self.request.onboard.device);
        ground.device_mib = self.request.onboard.budget_mib.saturating_mul(aircraft as u32);
        ground.max_gaussians = Some(self.request.onboard.max_gaussians * aircraft);
        ground.seed = self.request.seed;
        Ok(Some(ground))
    }

    /// Pictures that leave the aircraft that took them, each once, and the bytes of all copies.
    fn exchanged(&self, method: &Method) -> Result<(usize, u64), JobError> {
        let copies: Vec<usize> = match method.pictures {
            Pictures::Own => Vec::new(),
            Pictures::All => self.territories.iter().flat_map(|t| t.own.iter().copied()).collect(),
            Pictures::Seen => {
                let foreign = |(t, seen): (&Territory, &Vec<usize>)| {
                    seen.iter().copied().filter(|i| !t.own.contains(i)).collect::<Vec<_>>()
                };
                self.territories.iter().zip(&self.seen).flat_map(foreign).collect()
            }
        };
        let mut bytes = 0;
        for i in &copies {
            let path = &self.data.set.frames[*i].path;
            bytes += std::fs::metadata(path).map_err(JobError::io(path))?.len();
        }
        Ok((copies.iter().collect::<HashSet<_>>().len(), bytes))
    }

    /// Quality of a model, and its number of Gaussians.
    fn score(&self, path: &Path) -> Result<(Quality, usize), JobError> {
        let (request, set) = (self.request, &self.data.set);
        let sizes = self.held_out.iter().map(|&i| scaled(&set.frames[i].view.intrinsics, request.scale));
        let sizes = sizes.collect::<Result<Vec<_>, _>>()?;
        let (width, height) = sizes.iter().max_by_key(|k| k.pixels()).map_or((1, 1), |k| (k.width, k.height));
        let mut metric = open_metric(request.networks.metric.as_deref(), (width, height))?;
        let (header, cloud) = model::read(path)?;
        let mut trainer = renderer(request.onboard.device.as_deref(), &cloud, width, height)?;
        let into = IntoModel::of(set, &header);
        let scores = evaluate(&mut trainer, set, &self.held_out, request.scale, &into, metric.as_mut(), None)?;
        Ok((Quality::of(&scores, set, &self.held_out, &self.territories, self.ground_m), cloud.len()))
    }
}

/// The figures of an earlier run; what cannot be read is made anew.
fn earlier(path: &Path) -> Option<MethodResult> {
    serde_json::from_slice(&read_bounded(path, LIMIT).ok()?).ok()
}

fn stopped() -> JobError {
    let line = "stopped on request; what was measured so far is kept".into();
    JobError::Child { kind: ErrorKind::Interrupted, line }
}

/// Merges as `dgtr aggregate` does; the global model's file.
fn by_region(
    method: &Method,
    trained: &[Trained],
    ground: &GroundSettings,
    folder: &Path,
    cancelled: &dyn Fn() -> bool,
) -> Result<PathBuf, JobError> {
    let failed = |e: AggregateError| JobError::Child { kind: e.kind(), line: format!("{}: {e}", method.name) };
    let read = |t: &Trained| LocalModel::read(&t.model).map(Member::of);
    let members = trained.iter().map(read).collect::<Result<Vec<_>, _>>().map_err(failed)?;
    let outcome = aggregate::run(members, ground, None, folder, cancelled).map_err(failed)?;
    match outcome.not_distilled {
        Some(e) => Err(failed(e)),
        None if outcome.interrupted => Err(stopped()),
        None => Ok(outcome.path),
    }
}

/// Median height of the points; zero without any.
fn ground_height(points: &[SparsePoint]) -> f64 {
    let mut heights: Vec<f64> = points.iter().map(|p| p.position[2]).collect();
    heights.sort_by(f64::total_cmp);
    heights.get(heights.len() / 2).copied().unwrap_or(0.0)
}
