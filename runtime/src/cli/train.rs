//! `dgtr train DATASET --out DIR`: the onboard training, fed from a folder instead of an aircraft.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use config::budget::{Budget, Memory};
use config::error::ErrorKind;
use config::preset::Preset;
use engine::InitKind;
use models::formats::delivery::Rounding;
use models::formats::{FormatError, read_bounded};
use survey::card::CardOptions;
use survey::dataset::PoseSource;

use super::CliError;
use crate::cli::output::outln;
use crate::train_job::{Chosen, Output, PictureScale, PoseOrigin, Recipe, TrainJob, log};

/// A settings file has a few KiB.
const SETTINGS_LIMIT: u64 = 1 << 20;

/// Where the first Gaussians come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Init {
    /// The feed-forward network on pairs of pictures.
    FeedForward,
    /// The sparse points that came with the data set (only those at least two training pictures saw).
    Sfm,
    /// Points at random in what the cameras see.
    Random,
}

/// Where camera poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Poses {
    /// The reconstruction that came with the data set.
    Dataset,
    /// GPS and gimbal angles of gps.csv, refined from the pictures.
    Telemetry,
}

/// How finely a model for delivery is rounded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Fineness {
    /// As `dgtr export --to delivery` and `[upload] encoding = "delivery"` do.
    Coarse,
    /// As with `--fine` and `"fine"`: for what is seen from near.
    Fine,
}

impl Fineness {
    fn rounding(self) -> Rounding {
        match self {
            Self::Coarse => Rounding::default(),
            Self::Fine => Rounding::fine(),
        }
    }
}

/// Arguments of `dgtr train`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of posed pictures (nerfstudio, COLMAP, OpenDroneMap, Metashape, RealityScan, Bundler, OPF), or of a camera's card (DCIM).
    #[arg(required = true, value_name = "FOLDER")]
    pub folders: Vec<PathBuf>,
    /// Folder for model.dgtr and run.json; an unfinished model there is continued.
    #[arg(long)]
    pub out: PathBuf,
    /// Forget a model that is already in --out.
    #[arg(long)]
    fresh: bool,
    /// Do not score the split `test` at the end.
    #[arg(long)]
    no_eval: bool,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 30.0)]
    checkpoint_seconds: f64,
    #[command(flatten, next_help_heading = "Pictures")]
    pictures: PictureArgs,
    #[command(flatten, next_help_heading = "Poses and places")]
    poses: PoseArgs,
    #[command(flatten, next_help_heading = "First Gaussians")]
    start: StartArgs,
    #[command(flatten, next_help_heading = "Time and energy")]
    budget: Budget,
    #[command(flatten, next_help_heading = "Time and energy")]
    limits: LimitArgs,
    #[command(flatten, next_help_heading = "Memory and device")]
    memory: Memory,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long, help_heading = "Memory and device")]
    device: Option<String>,
    #[command(flatten, next_help_heading = "Recipe")]
    recipe: RecipeArgs,
}

#[derive(Debug, clap::Args)]
struct PictureArgs {
    /// Which pictures, by split.json; without that file every 8th is held out.
    #[arg(long, default_value = "train")]
    split: String,
    /// Only the pictures of this region.
    #[arg(long)]
    region: Option<String>,
    /// Only key frames by a flight's rule: [keyframes] of --settings, or its defaults.
    #[arg(long)]
    keyframes: bool,
    /// Image scale, above 0 and at most 1 [default: as large as the budget holds].
    #[arg(long)]
    scale: Option<f64>,
}

#[derive(Debug, clap::Args)]
struct PoseArgs {
    /// Where camera poses come from.
    #[arg(long, value_enum, default_value = "dataset")]
    poses: Poses,
    /// Take telemetry poses as they are.
    #[arg(long)]
    no_refine: bool,
    #[command(flatten)]
    card: CardArgs,
}

#[derive(Debug, clap::Args)]
struct StartArgs {
    /// Where the first Gaussians come from.
    #[arg(long, value_enum, default_value = "feed-forward")]
    init: Init,
    /// Begin with the Gaussians of this model, which lies in the data set's frame; the schedule begins anew.
    #[arg(long, value_name = "MODEL", conflicts_with = "init")]
    from: Option<PathBuf>,
    /// Manifest of your own feed-forward network.
    #[arg(long = "model", value_name = "FILE")]
    network: Option<PathBuf>,
}

#[derive(Debug, clap::Args)]
struct LimitArgs {
    /// Watts that this computer takes while it trains, where it does not say so itself.
    #[arg(long, requires = "energy_wh")]
    watts: Option<f32>,
    /// Budgets of a size of job, for whatever of --budget-mib, --max-gaussians, --scale and --seconds is not given.
    #[arg(long, value_parser = presets())]
    preset: Option<Preset>,
    /// Pause or slow down as a flight does when this computer is hot, throttled or weakly fed.
    #[arg(long)]
    failsafe: bool,
}

#[derive(Debug, clap::Args)]
struct RecipeArgs {
    /// Seed of everything random; the same seed on the same device gives the same model.
    #[arg(long)]
    seed: Option<u64>,
    /// Prune what the loss needs least and train with quantised values, for `dgtr export --to delivery`.
    #[arg(long, value_enum, num_args = 0..=1, require_equals = true, default_missing_value = "coarse")]
    for_delivery: Option<Fineness>,
    /// TOML file with any of the mission file's tables [training], [init], [refine], [network], [keyframes], [failsafe].
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
}

/// What a card of pictures is read with.
#[derive(Debug, clap::Args)]
struct CardArgs {
    /// Positions of a card's pictures: OpenDroneMap's geo.txt, a table whose columns are named or Pix4D's, a film's .SRT.
    #[arg(long, value_name = "FILE")]
    geotags: Option<PathBuf>,
    /// The flight's log beside a card, MAVLink (.tlog), ArduPilot (.BIN) or PX4 (.ulg), matched by order and time.
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// MAVLink system whose exposures in --log are meant [default: the one that the pictures fit].
    #[arg(long, value_name = "N", requires = "log")]
    system: Option<u8>,
    /// Number of the camera whose exposures in --log are meant [default: the one that the pictures fit].
    #[arg(long, value_name = "N", requires = "log")]
    camera: Option<u8>,
    /// Surveyed points marked in a card's pictures, beside those of its gcp_list.txt; those named CHK-… measure the finished model alone.
    #[arg(long, value_name = "FILE")]
    gcp: Option<PathBuf>,
    /// Of a card with several bands or lenses the one of this name [default: natural colours].
    #[arg(long, value_name = "NAME", help_heading = "Pictures")]
    band: Option<String>,
    /// Surveyed points in a file of that form that measure the finished model instead of helping it.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
}

impl CardArgs {
    fn options(self) -> Result<CardOptions, CliError> {
        Ok(CardOptions {
            geotags: self.geotags,
            control: self.gcp,
            check: self.check,
            log: self.log.as_deref().map(|path| log::read(path, self.system, self.camera)).transpose()?,
            band: self.band,
        })
    }
}

impl RecipeArgs {
    /// The tables of the settings file, and its seed unless another is given.
    fn read(&self) -> Result<Recipe, CliError> {
        let mut recipe = match &self.settings {
            None => Recipe::default(),
            Some(path) => {
                let bad = |what: String| CliError::from(FormatError::Invalid { path: path.clone(), what });
                let bytes = read_bounded(path, SETTINGS_LIMIT)?;
                let text = String::from_utf8(bytes).map_err(|_| bad("not UTF-8 text".to_owned()))?;
                let mut recipe: Recipe = config::settings::parse(&text).map_err(|e| bad(e.to_string()))?;
                recipe.network.anchor(path.parent().unwrap_or(Path::new("")));
                recipe
            }
        };
        recipe.keyframes.check()?;
        recipe.failsafe.check()?;
        recipe.coverage.check()?;
        recipe.training.seed = self.seed.unwrap_or(recipe.training.seed);
        Ok(recipe)
    }
}

/// The presets as clap shows them, each with its budgets.
pub(super) fn presets() -> impl TypedValueParser<Value = Preset> {
    let described = |(name, preset): &(&'static str, Preset)| {
        let chosen =
            || "chosen by what a step costs on the device, measured once (kept in the cache folder)".to_owned();
        PossibleValue::new(*name).help(preset.values().map_or_else(chosen, |v| v.to_string()))
    };
    PossibleValuesParser::new(Preset::ALL.iter().map(described).collect::<Vec<_>>())
        .try_map(|name| Preset::named(&name).ok_or("no such preset"))
}

/// Runs `dgtr train`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    for (name, value) in [("--seconds", args.budget.seconds), ("--checkpoint-seconds", Some(args.checkpoint_seconds))] {
        if value.is_some_and(|v| !(v > 0.0 && v.is_finite())) {
            return Err(CliError::input(format!("{name} must be a positive number of seconds")));
        }
    }
    let mut recipe = args.recipe.read()?;
    if args.start.network.is_some() {
        recipe.network.pair = args.start.network;
    }
    let training = &mut recipe.training;
    training.energy_wh = args.budget.energy_wh.or(training.energy_wh);
    training.watts = args.limits.watts.or(training.watts);
    training.check()?;
    let preset = args.limits.preset.and_then(Preset::values);
    // A schedule in steps, in watt-hours or in a settings file is not cut short by a preset.
    let is_said = args.budget.steps.is_some() || training.seconds.is_some() || training.energy_wh.is_some();
    let of_preset = preset.filter(|_| !is_said).map(|p| p.seconds);
    let job = TrainJob {
        folders: args.folders,
        card: args.poses.card.options()?,
        output: Output { folder: args.out, fresh: args.fresh, checkpoint_seconds: args.checkpoint_seconds },
        pictures: Chosen {
            split: args.pictures.split,
            region: args.pictures.region,
            by_rule: args.pictures.keyframes,
            scale: match (args.pictures.scale, preset) {
                (Some(scale), _) => PictureScale::Exactly(scale),
                (None, Some(preset)) => PictureScale::OfJob(preset.image_scale.into()),
                (None, None) => PictureScale::AsHeld,
            },
        },
        poses: PoseOrigin {
            source: match args.poses.poses {
                Poses::Dataset => PoseSource::Dataset,
                Poses::Telemetry => PoseSource::Telemetry,
            },
            refine: !args.poses.no_refine,
        },
        init: match args.start.init {
            _ if args.start.from.is_some() => InitKind::Model,
            Init::FeedForward => InitKind::FeedForward,
            Init::Sfm => InitKind::SparsePoints,
            Init::Random => InitKind::Random,
        },
        from: args.start.from,
        budget: Budget { seconds: args.budget.seconds.or(of_preset), ..args.budget },
        memory: Memory {
            device_mib: args.memory.device_mib.or(preset.map(|p| p.device_mib)),
            max_gaussians: args.memory.max_gaussians.or(preset.map(|p| p.max_gaussians)),
            ..args.memory
        },
        auto: args.limits.preset == Some(Preset::Auto),
        spares: args.limits.failsafe,
        device: args.device,
        for_delivery: args.recipe.for_delivery.map(Fineness::rounding),
        evaluate: !args.no_eval,
        recipe,
    };
    let ended = job.run()?;
    let model = job.model_path();
    if !ended.finished && !model.is_file() {
        return Err(CliError::interrupted(format!(
            "interrupted before there was a model in {}; the same command begins again",
            job.output.folder.display()
        )));
    }
    if !ended.finished {
        return Err(CliError::interrupted(format!(
            "interrupted after {} steps; {} is valid, the same command continues it",
            ended.steps,
            model.display()
        )));
    }
    let report = ended.report;
    let quality = report.psnr.map_or(String::new(), |p| format!(", held-out PSNR {p:.2} dB"));
    outln!(
        "{}: {} Gaussians after {} steps, {:.1} s{quality}",
        model.display(),
        report.gaussians,
        ended.steps,
        report.wall_s
    );
    match ended.few {
        Some((used, of)) => Err(CliError::new(
            ErrorKind::Partial,
            format!(
                "{} is of {used} of {of} pictures: the others could not be tied to them; take them with more overlap",
                model.display()
            ),
        )),
        None => Ok(()),
    }
}
