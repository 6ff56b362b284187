//! The reconstruction engine: posed pictures in, a trained model out, in the order capture → refine → initialise → train →
//! checkpoint. A flight and `dgtr train` differ in their [`PictureSource`] and in [`EngineSettings`], not in the work.
//!
//! All memory is planned when it is opened. A picture comes by once: matching takes its features, the trainer its pixels,
//! and what initialisation needs of it later is read from where the trainer keeps them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use config::init::InitSettings;
use config::map::MapSettings;
use config::mission::NetworkSettings;
use config::refine::RefineSettings;
use config::training::TrainSettings;
use disk::Disk;
use job::run_json::RunReport;
use models::camera::{DepthPrior, PoseSigma, PosedImage, View};
use models::cloud::GaussianCloud;
use models::formats::delivery::Rounding;
use models::formats::model::{Chunks, ModelHeader};
use models::init::Initialiser;
use models::light::PictureLight;
use models::onnx::depth::DepthNetwork;
use models::refine::{RefineReport, Refiner};
use vulkan::trainer::Trainer;

use crate::error::EngineError;

mod average;
mod budget;
#[cfg(test)]
#[path = "../../../tests/carpet.rs"]
mod carpet;
mod carry;
pub mod cost;
mod crops;
mod delivery;
pub mod device;
pub mod devices;
pub mod energy;
pub mod error;
pub mod evaluate;
pub mod failsafe;
mod first_gaussians;
mod follow;
mod growth;
pub mod host;
pub mod kernels;
mod light;
mod map;
pub mod ortho;
pub mod pieces;
pub mod preset;
mod rebuild;
mod reconstruct;
pub mod source;
#[cfg(test)]
mod testing;
pub mod transfer;
mod waiting;

use device::DeviceRequest;
use first_gaussians::{FirstGaussians, feed_forward};
pub use first_gaussians::{InitKind, Point};
use host::{HostPlan, HostRequest};
pub use reconstruct::Reconstruct;
pub use source::PictureSource;
pub use waiting::{matching_file_bytes, scratch_bytes, waiting_file};

/// What the engine needs to know before the first picture.
#[derive(Clone, Debug)]
pub struct EngineSettings {
    /// Where checkpoints are written to and read from.
    pub disk: Disk,
    /// Device and budget.
    pub device: DeviceRequest,
    /// `memory.host_mib`: bound on the host's memory, MiB.
    pub host_mib: Option<u32>,
    /// Pixels of a picture as it leaves the camera.
    pub camera_pixels: u64,
    /// Pictures that the source decodes ahead.
    pub ahead: usize,
    /// Their camera's own pictures wait in memory with them.
    pub ahead_in_memory: bool,
    /// To what models are rounded for delivery while the job goes on.
    pub delivers: Option<Rounding>,
    /// `[map]`: what is drawn after each build; `None` draws nothing.
    pub map: Option<MapSettings>,
    /// Pictures are trained at this fraction of the size they come in; matching sees them whole.
    pub scale: f64,
    /// `[network]`: manifests of the user's own networks.
    pub network: NetworkSettings,
    /// `[training]`.
    pub training: TrainSettings,
    /// `[init]`.
    pub init: InitSettings,
    /// `[refine]`; `None` takes poses as they are.
    pub refine: Option<RefineSettings>,
    /// First Gaussians.
    pub start: InitKind,
    /// Refine, estimate depths and build while pictures still come, and keep what is trained over a rebuild; else everything
    /// is done once, with all pictures there.
    pub incremental: bool,
}

/// Where the model lies in an output folder.
pub fn model_path(out: &Path) -> PathBuf {
    out.join("model.dgtr")
}

/// One model in the making.
pub struct Reconstruction {
    settings: EngineSettings,
    header: ModelHeader,
    refiner: Option<Refiner>,
    initialiser: Option<Initialiser>,
    /// The user's own network for the depth loss.
    depth: Option<DepthNetwork>,
    trainer: Trainer,
    /// What the trainer trains on.
    pictures: light::LitPictures,
    /// As of the last checkpoint; none where the scene is in pieces.
    cloud: GaussianCloud,
    /// All Gaussians are in the trainer's file only.
    in_pieces: bool,
    /// The model whose Gaussians are the first.
    first: Option<Chunks>,
    /// Key frames with lens and pose as they are known now, in the order of the trainer's views.
    views: Vec<(String, View)>,
    /// Number of each by its name.
    index: HashMap<String, usize>,
    /// How many of them the initialiser has.
    initialised: usize,
    /// Key frames were tied to others since the poses were last solved.
    unsolved: bool,
    /// Pictures still come.
    flying: bool,
    /// What was added to the model since it was built.
    growing: growth::Growing,
    /// Typical depth of the pictures, metres.
    depth_m: f32,
    /// Views as the Gaussians know them.
    built: Vec<View>,
    /// Views of the model that is continued.
    resumed: HashMap<String, View>,
    /// Lights of the model that is continued.
    resumed_lights: HashMap<String, PictureLight>,
    /// Points of the scene known beforehand.
    points: Vec<Point>,
    /// The last refinement.
    refined: Option<RefineReport>,
    builds: u32,
    /// The build that the last map shows.
    mapped: u32,
    /// What the schedule takes, where its energy is bounded.
    meter: Option<energy::Meter>,
    /// What has been done to the model for its delivery.
    delivery: delivery::Delivery,
    /// What the cloud is the mean of.
    average: average::Average,
    /// Seconds of training over all continuations.
    train_s: f64,
    /// What was done and what it took.
    pub report: RunReport,
}

impl Reconstruction {
    /// Opens networks and device. What the user names is looked at before anything slow begins.
    ///
    /// # Errors
    /// Anything missing that the job cannot do without: ONNX Runtime, a Vulkan device, memory.
    pub fn open(mut settings: EngineSettings, header: ModelHeader, command: &str) -> Result<Self, EngineError> {
        let _span = tracing::info_span!("open").entered();
        if let Some(rounding) = &settings.delivers {
            settings.training.loss.view_dependence_visits = 0;
            settings.training.loss.view_dependence *= rounding.view_dependence;
        }
        let meter = energy::Meter::of(&settings.training)?;
        let (views, mut init) = (settings.device.views, settings.init.clone());
        let depth = settings.network.depth.as_deref().filter(|_| settings.training.loss.depth > 0.0);
        let depth = depth
            .map(|path| DepthNetwork::open(path, settings.device.size, init.max_side, init.threads))
            .transpose()?;
        let refiner = settings.refine.as_ref().map(|refine| {
            Refiner::open(&RefineSettings { max_keyframes: refine.max_keyframes.max(views), ..refine.clone() })
        });
        init.max_pictures = init.max_pictures.max(views);
        // Another start asks the network for depths only.
        let wants_depths = init.depth_priors && depth.is_none() && settings.training.loss.depth > 0.0;
        let mut initialiser = match settings.start {
            InitKind::SparsePoints | InitKind::Random | InitKind::Model if !wants_depths => None,
            _ => Some(Initialiser::open(&init, settings.network.pair.as_deref())?),
        };
        let (trainer, pictures): (Trainer, _) = settings.device.open::<EngineError>(&settings.training)?;
        let in_pieces = pieces::is_in_pieces(&settings, &trainer);
        let mut refiner: Option<Refiner> = refiner.transpose()?;
        let plan = |initialiser: u64, refine_in_file: bool| {
            HostPlan::new(&HostRequest {
                plan: trainer.plan(),
                on_host: if trainer.device().gpu().info().is_cpu {
                    trainer.device().bytes()
                } else {
                    trainer.device().mirror_bytes()
                },
                initialiser,
                refine: settings.refine.as_ref(),
                refine_in_file,
                camera_pixels: settings.camera_pixels,
                ahead: settings.ahead as u64,
                ahead_in_memory: settings.ahead_in_memory,
                delivers: settings.delivers.is_some(),
                from_file: in_pieces && settings.start == InitKind::Model,
                map: settings.map.map_or(0, |m| m.host_bytes()),
            })
        };
        let host = waiting::place(&settings, trainer.plan(), initialiser.as_mut(), refiner.as_mut(), &plan)?;
        let mut report = RunReport::new(command);
        report.more.insert("host_bytes_planned".into(), host.total_bytes().into());
        report.device = trainer.device().gpu().info().name.clone();
        report.seed = header.seed;
        (report.device_bytes_planned, report.device_bytes_peak) =
            (trainer.plan().total_bytes, trainer.device().bytes());
        Ok(Self {
            refiner,
            initialiser,
            depth,
            cloud: match in_pieces {
                true => GaussianCloud::with_capacity(settings.training.sh.degree, 0),
                false => GaussianCloud::with_memory(settings.training.sh.degree, trainer.plan().scene),
            },
            in_pieces,
            first: None,
            trainer,
            pictures: light::LitPictures::new(pictures),
            views: Vec::with_capacity(views),
            index: HashMap::with_capacity(views),
            flying: settings.incremental,
            growing: growth::Growing::default(),
            depth_m: 0.0,
            initialised: 0,
            unsolved: false,
            built: Vec::with_capacity(views),
            resumed: HashMap::new(),
            resumed_lights: HashMap::new(),
            points: Vec::new(),
            refined: None,
            builds: 0,
            mapped: 0,
            meter,
            delivery: delivery::Delivery::default(),
            average: average::Average::default(),
            train_s: 0.0,
            header,
            settings,
            report,
        })
    }

    /// Takes up the model of an earlier run in `out`, when there is one of the same mission and aircraft that holds
    /// Gaussians; its views.
    ///
    /// # Errors
    /// A damaged model file that cannot be set aside.
    pub fn resume(&mut self, out: &Path) -> Result<Option<&HashMap<String, View>>, EngineError> {
        let path = model_path(out);
        let Some(earlier) = self.earlier(out)? else { return Ok(None) };
        let (header, gaussians) = (earlier.header().clone(), earlier.gaussians());
        let same = header.mission == self.header.mission && header.aircraft == self.header.aircraft;
        if !same || gaussians == 0 {
            return Ok(None);
        }
        tracing::info!("continuing {} ({gaussians} Gaussians) after {} steps", path.display(), header.steps);
        // Models of earlier versions say it themselves.
        let told = RunReport::read(out).ok().and_then(|run| run.more.get("train_seconds")?.as_f64());
        self.train_s = told.unwrap_or(header.train_seconds);
        (self.header.steps, self.header.thinned) = (header.steps, header.thinned);
        match earlier {
            pieces::Earlier::Whole(_, cloud) => self.cloud.clone_from(&cloud),
            pieces::Earlier::Pieces(model) => self.first = Some(model),
        }
        let names = header.views.iter().map(|(name, _)| name.clone());
        self.resumed_lights = names.zip(header.lights).collect();
        self.resumed = header.views.into_iter().collect();
        if !self.settings.incremental {
            // Poses are those of the last checkpoint, and Gaussians are there: what is left to make are depth priors.
            self.refiner = None;
            if self.settings.training.loss.depth <= 0.0 || self.depth.is_some() {
                self.initialiser = None;
            }
        }
        Ok(Some(&self.resumed))
    }

    /// Points of the scene that came with the pictures.
    pub fn hint_points(&mut self, points: Vec<Point>) {
        self.points = points;
    }

    /// The trainer, for its counters and for rendering.
    pub fn trainer(&mut self) -> &mut Trainer {
        &mut self.trainer
    }

    /// What the model file says of itself, as of the last checkpoint.
    pub fn header(&self) -> &ModelHeader {
        &self.header
    }

    /// Seconds of training over all continuations.
    pub fn train_seconds(&self) -> f64 {
        self.train_s
    }

    /// Whether the model that is continued was trained on exactly these pictures.
    fn is_continued(&self) -> bool {
        self.builds == 0
            && self.resumed.len() == self.views.len()
            && self.views.iter().all(|(name, _)| self.resumed.contains_key(name))
    }

    /// The best poses and lenses of all key frames.
    fn refine(&mut self) -> Result<(), EngineError> {
        let Some(refiner) = &mut self.refiner else { return Ok(()) };
        let _span = tracing::info_span!("refine").entered();
        let from = Instant::now();
        let solved = refiner.solve()?;
        for (name, view) in &mut self.views {
            take_refined(refiner, &mut self.initialiser, name, view);
        }
        self.refined = Some(solved);
        self.growing.all_placed(self.views.len());
        self.report.stage("refine", from);
        Ok(())
    }

    /// Gives the initialiser the first `until` views that waited for their pose, with the pixels that the trainer keeps.
    fn initialise_waiting(&mut self, until: usize) -> Result<(), EngineError> {
        let Some(initialiser) = &mut self.initialiser else { return Ok(()) };
        for i in self.initialised..until {
            if let Some(view) = self.pictures.store.view(i) {
                let (image, mask) = (
                    self.pictures.store.image(self.trainer.device_mut(), i)?,
                    self.pictures.store.mask(self.trainer.device_mut(), i)?,
                );
                let (name, View { pose, .. }) = self.views[i].clone();
                let view = View { pose, ..view };
                let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
                initialiser.add(&PosedImage { name, time_ns: 0, image, mask, view, sigma })?;
            }
        }
        self.initialised = self.initialised.max(until);
        Ok(())
    }

    /// Gaussians and depth priors of all key frames; `None` when `go_on` said no.
    fn initialise(&mut self, go_on: &dyn Fn() -> bool) -> Result<Option<FirstGaussians>, EngineError> {
        let _span = tracing::info_span!("initialise").entered();
        if let Some(refiner) = &self.refiner {
            self.points = refiner.sparse_points().iter().map(|p| (p.position, p.color)).collect();
        }
        let at_once = !self.settings.incremental;
        if let (Some(initialiser), Some(_)) = (&mut self.initialiser, &self.refiner) {
            initialiser.hint_points(self.points.iter().map(|p| p.0.map(|v| v as f32)));
        }
        self.initialise_waiting(self.views.len())?;
        let share = (self.flying && self.can_grow()).then(|| self.share());
        // Where the first Gaussians are there already, those that come with the depths are thrown away.
        let plan = self.trainer.plan();
        let capacity = if self.first.is_some() { plan.gaussians } else { plan.scene };
        if let Some(initialiser) = &mut self.initialiser {
            let capacity = share.map_or(capacity, |share| share.of(initialiser.ground_m2()));
            let index = &self.index;
            let (trainer, pictures, own_network) = (&mut self.trainer, &mut self.pictures.store, self.depth.is_some());
            let mut failed = Ok(());
            let mut prior = |name: &str, depth: DepthPrior| {
                if let (Some(&i), Ok(()), false) = (index.get(name), &failed, own_network) {
                    failed = pictures.set_prior(trainer.device_mut(), i, Some(&depth));
                }
            };
            let made = feed_forward(initialiser, self.views.len(), capacity, at_once, &mut prior, go_on)?;
            failed?;
            return match made {
                // Asked for its depths alone: neither its Gaussians nor the light it found.
                Some(made) if self.settings.start != InitKind::FeedForward => {
                    Ok(Some(FirstGaussians { cloud: self.other_start(capacity)?, light: None, ..made }))
                }
                made => Ok(made),
            };
        }
        Ok(Some(self.other_start(capacity)?.into()))
    }
}

/// What refinement knows of a view by now: for the view, and for the initialiser's picture of it.
fn take_refined(refiner: &Refiner, initialiser: &mut Option<Initialiser>, name: &str, view: &mut View) {
    if let Some(pose) = refiner.pose(name) {
        view.pose = pose;
        if let Some(initialiser) = initialiser {
            initialiser.update_pose(name, &pose);
        }
    }
    if let Some(lens) = refiner.intrinsics(name) {
        view.intrinsics = lens.resized(view.intrinsics.width, view.intrinsics.height);
    }
}
