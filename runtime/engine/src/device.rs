//! What every job opens before its first picture: the device, the plan of its memory, the trainer. The one place that asks
//! for a plan.

use std::fs::File;
use std::path::{Path, PathBuf};

use config::budget::Memory;
use config::mission::Mission;
use config::plan::{Lanes, Plan, PlanError, PlanRequest};
use config::training::{ShSettings, TrainSettings};
use models::camera::Intrinsics;
use models::cloud::GaussianCloud;
use models::formats::FormatError;
use models::formats::model::{self, Chunks, ModelHeader};
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use survey::ortho::grid::DRAWN;
use vulkan::trainer::{PictureStore, TrainError, Trainer};

use super::pieces;
use crate::error::EngineError;
use tuning::devices;
use tuning::kernels;

/// Gaussian–tile instances that a renderer holds at once, per pixel; pictures with more are rendered in bands.
const INSTANCES_PER_PIXEL: usize = 8;
/// Gaussian–tile instances per pixel that the renderer of a map's block holds.
const INSTANCES_PER_MAP_PIXEL: usize = 2;

/// The lens of the pictures that a flight trains on.
pub fn training_lens(mission: &Mission) -> Intrinsics {
    let c = &mission.camera;
    let full = Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
    let (width, height) = mission.memory.training_size((c.width, c.height));
    full.resized(width, height)
}

/// Crops that a flight with as many key frames as it may have takes.
fn crops_of_flight(mission: &Mission) -> u32 {
    let (camera, lens, settings) = (&mission.camera, training_lens(mission), &mission.training.crops);
    let each = settings.planned((camera.width, camera.height), (lens.width, lens.height));
    mission.keyframes.max.saturating_mul(each).min(settings.most)
}

/// What a job wants of which device.
#[derive(Clone, Debug)]
pub struct DeviceRequest {
    /// Part of the device's name.
    pub device: Option<String>,
    /// What the plan is made from.
    pub memory: Memory,
    /// Width and height of the largest picture, pixels; the trainer fits the others in.
    pub size: (u32, u32),
    /// Training views.
    pub views: usize,
    /// Crops of larger pictures at the most.
    pub crops: usize,
    /// Where the file of the others lies; absent: the system's temporary folder.
    pub folder: Option<PathBuf>,
}

impl DeviceRequest {
    /// The request that [`Plan`] is made of; `lanes` are the device's.
    pub fn plan_request(&self, sh: &ShSettings, lanes: Lanes) -> PlanRequest {
        PlanRequest {
            device_mib: self.memory.device_mib(),
            width: self.size.0,
            height: self.size.1,
            views: self.views as u32,
            crops: self.crops as u32,
            view_slots: self.memory.view_slots,
            sh_degree: sh.degree,
            max_gaussians: self.memory.max_gaussians.map(|n| n as usize),
            scene_gaussians: self.memory.scene_gaussians.map(|n| n as usize),
            half_moments: sh.half_moments,
            lanes,
        }
    }

    /// What a flight of `mission` asks for: pictures at the working size, as many views as there may be key frames.
    pub fn of_flight(mission: &Mission, folder: Option<PathBuf>) -> Self {
        let (memory, lens) = (&mission.memory, training_lens(mission));
        Self {
            device: None,
            memory: memory.into(),
            size: (lens.width, lens.height),
            views: mission.keyframes.max as usize,
            crops: crops_of_flight(mission) as usize,
            folder,
        }
    }

    /// Opens the device, allocates the plan, and makes room for the pictures. Call it before anything that must not wait: a device seen for the first
    /// time is measured for a second or two.
    ///
    /// # Errors
    /// No device, or a plan that does not fit into it or into `device_mib`.
    pub fn open<E: From<PlanError> + From<TrainError>>(
        &self,
        training: &TrainSettings,
    ) -> Result<(Trainer, PictureStore), E> {
        let gpu = devices::open(self.device.as_deref()).map_err(TrainError::from)?;
        let request = self.plan_request(&training.sh, gpu.info().lanes());
        let mut trainer = Trainer::with_config(&gpu, &Plan::new(&request)?, training, kernels::config_of(&gpu))?;
        let mut pictures = PictureStore::new(trainer.plan());
        if request.view_file_bytes() > 0 {
            pictures.keep_in(scratch_file(&self.scratch_folder(), request.view_file_bytes())?);
        }
        if trainer.plan().is_paged() {
            trainer.keep_scene_in(scratch_file(&self.scratch_folder(), trainer.plan().scene_file_bytes())?);
        }
        Ok((trainer, pictures))
    }

    /// Where the job's scratch files lie.
    pub(super) fn scratch_folder(&self) -> PathBuf {
        self.folder.clone().unwrap_or_else(std::env::temp_dir)
    }
}

/// A file without a name in `folder`, as large as it will ever be: it goes with the process, however that ends.
///
/// # Errors
/// The folder cannot be made or written to, or has no room.
pub(super) fn scratch_file(folder: &Path, bytes: u64) -> Result<File, TrainError> {
    allocated(folder, bytes)
        .map_err(|e| TrainError::ViewFile(format!("{} MiB in {}: {}", bytes >> 20, folder.display(), disk::told(&e))))
}

fn allocated(folder: &Path, bytes: u64) -> std::io::Result<File> {
    std::fs::create_dir_all(folder)?;
    let file = tempfile::tempfile_in(folder)?;
    match fallocate(&file, FallocateFlags::empty(), 0, bytes) {
        // Some file systems cannot set room aside: there it is taken as views come.
        Err(Errno::OPNOTSUPP) => file.set_len(bytes)?,
        other => other?,
    }
    Ok(file)
}

/// A trained model ready to be rendered, with as little memory as rendering takes: `cloud` on the device for pictures of up
/// to `width` × `height` (larger ones are rendered in windows).
///
/// # Errors
/// No device, or not enough of its memory; an empty cloud.
pub fn renderer(device: Option<&str>, cloud: &GaussianCloud, width: u32, height: u32) -> Result<Trainer, EngineError> {
    let mut trainer = filled_renderer(device, (cloud.sh_degree, cloud.len()), (width, height), INSTANCES_PER_PIXEL)?;
    trainer.load(cloud)?;
    Ok(trainer)
}

/// A renderer of a model's file, and its header. The host never holds more than a piece of the file, or a cell of a quantised one. Of a file
/// that is cut short it shows what is there.
///
/// # Errors
/// Errors of [`renderer`], and of [`model::read_what_is_there`].
pub fn file_renderer(
    device: Option<&str>,
    path: &Path,
    (width, height): (u32, u32),
) -> Result<(ModelHeader, Trainer), EngineError> {
    let whole = Chunks::open(path).map_err(EngineError::from).and_then(|model| {
        let trainer = renderer_of_pieces(device, &model, (width, height), INSTANCES_PER_PIXEL)?;
        Ok((model.header, trainer))
    });
    match whole {
        // Whether cells are there shows when they are read.
        Err(EngineError::File(FormatError::Truncated { .. } | FormatError::TooLarge { .. })) => {
            let (header, cloud, _) = model::read_what_is_there(path)?;
            Ok((header, renderer(device, &cloud, width, height)?))
        }
        whole => whole,
    }
}

/// A renderer of the blocks of a map, in less memory: where more Gaussians meet, a block is drawn in bands.
///
/// # Errors
/// Errors of [`renderer`]; the model cannot be read any more.
pub fn map_renderer(device: Option<&str>, model: &Chunks) -> Result<Trainer, EngineError> {
    renderer_of_pieces(device, model, (DRAWN, DRAWN), INSTANCES_PER_MAP_PIXEL)
}

fn renderer_of_pieces(
    device: Option<&str>,
    model: &Chunks,
    size: (u32, u32),
    instances_per_pixel: usize,
) -> Result<Trainer, EngineError> {
    let mut trainer = filled_renderer(device, (model.sh_degree, model.count), size, instances_per_pixel)?;
    pieces::load(&mut trainer, model)?;
    Ok(trainer)
}

/// One for so many Gaussians, of which there must be some.
fn filled_renderer(
    device: Option<&str>,
    (sh_degree, gaussians): (u8, usize),
    size: (u32, u32),
    instances_per_pixel: usize,
) -> Result<Trainer, EngineError> {
    if gaussians == 0 {
        let what = "the model holds no Gaussians; train it first (dgtr train continues it)";
        return Err(EngineError::Request(what.into()));
    }
    empty_renderer(device, (sh_degree, gaussians), size, instances_per_pixel)
}

/// One for any clouds of at most `gaussians` of this SH degree, one after another.
///
/// # Errors
/// No device, or not enough of its memory.
pub fn renderer_of_parts(
    device: Option<&str>,
    sh_degree: u8,
    gaussians: usize,
    (width, height): (u32, u32),
) -> Result<Trainer, EngineError> {
    empty_renderer(device, (sh_degree, gaussians), (width, height), INSTANCES_PER_PIXEL)
}

fn empty_renderer(
    device: Option<&str>,
    (sh_degree, gaussians): (u8, usize),
    (width, height): (u32, u32),
    instances_per_pixel: usize,
) -> Result<Trainer, EngineError> {
    let gpu = devices::open_known(device)?;
    let mut settings = TrainSettings::default();
    settings.sh.degree = sh_degree;
    let request = DeviceRequest {
        device: None,
        memory: Memory::for_gaussians(u32::MAX, gaussians),
        size: (width, height),
        views: 0,
        crops: 0,
        folder: None,
    };
    let request = request.plan_request(&settings.sh, gpu.info().lanes());
    let pixels = width as usize * height as usize;
    let plan = Plan::with_capacities(&request, gaussians, gaussians + instances_per_pixel * pixels);
    Ok(Trainer::with_config(&gpu, &plan, &settings, kernels::known(gpu.info()).0)?)
}
