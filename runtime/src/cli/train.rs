//! `dgtr train DATASET --out DIR`: the onboard training, fed from a folder instead of an aircraft.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use config::coverage::CoverageSettings;
use config::failsafe::FailsafeSettings;
use config::init::InitSettings;
use config::mission::{KeyframeSettings, NetworkSettings};
use config::preset::Preset;
use config::refine::RefineSettings;
use config::training::TrainSettings;
use engine::InitKind;
use models::formats::delivery::Rounding;
use models::formats::{FormatError, read_bounded};
use serde::Deserialize;
use survey::card::CardOptions;
use survey::dataset::PoseSource;

use super::CliError;
use crate::cli::output::outln;
use crate::train_job::{PictureScale, TrainJob, log};

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

    /// Which pictures, by split.json; without that file every 8th is held out.
    #[arg(long, default_value = "train", help_heading = PICTURES)]
    split: String,
    /// Only the pictures of this region.
    #[arg(long, help_heading = PICTURES)]
    region: Option<String>,
    /// Only key frames by a flight's rule: [keyframes] of --settings, or its defaults.
    #[arg(long, help_heading = PICTURES)]
    keyframes: bool,
    /// Image scale, above 0 and at most 1 [default: as large as the budget holds].
    #[arg(long, help_heading = PICTURES)]
    scale: Option<f64>,

    /// Where camera poses come from.
    #[arg(long, value_enum, default_value = "dataset", help_heading = POSES)]
    poses: Poses,
    /// Take telemetry poses as they are.
    #[arg(long, help_heading = POSES)]
    no_refine: bool,
    #[command(flatten)]
    card: CardArgs,

    /// Where the first Gaussians come from.
    #[arg(long, value_enum, default_value = "feed-forward", help_heading = START)]
    init: Init,
    /// Begin with the Gaussians of this model, which lies in the data set's frame; the schedule begins anew.
    #[arg(long, value_name = "MODEL", conflicts_with = "init", help_heading = START)]
    from: Option<PathBuf>,
    /// Manifest of your own feed-forward network.
    #[arg(long = "model", value_name = "FILE", help_heading = START)]
    network: Option<PathBuf>,

    /// Optimiser steps [default: a hundred visits to each picture].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..), help_heading = BUDGET)]
    steps: Option<u32>,
    /// Seconds of training; with --steps, whichever comes first.
    #[arg(long, help_heading = BUDGET)]
    seconds: Option<f64>,
    /// Watt-hours that training may take, by what the board measures or --watts says.
    #[arg(long, help_heading = BUDGET)]
    energy_wh: Option<f64>,
    /// Watts that this computer takes while it trains, where it does not say so itself.
    #[arg(long, requires = "energy_wh", help_heading = BUDGET)]
    watts: Option<f32>,
    /// Budgets of a size of job, for whatever of --budget-mib, --max-gaussians, --scale and --seconds is not given.
    #[arg(long, value_parser = presets(), help_heading = BUDGET)]
    preset: Option<Preset>,
    /// Pause or slow down as a flight does when this computer is hot, throttled or weakly fed.
    #[arg(long, help_heading = BUDGET)]
    failsafe: bool,

    /// Device memory, MiB, allocated once [default: 512].
    #[arg(long, help_heading = MEMORY)]
    budget_mib: Option<u32>,
    /// Most Gaussians on the device [default: what the budget holds].
    #[arg(long, help_heading = MEMORY)]
    max_gaussians: Option<usize>,
    /// Gaussians of the whole scene, when the device holds fewer; the others wait in a file in --out.
    #[arg(long, value_name = "N", help_heading = MEMORY)]
    scene_gaussians: Option<usize>,
    /// Pictures on the device at once; the others wait in a file in --out [default: what half of the budget holds].
    #[arg(long, value_name = "N", help_heading = MEMORY)]
    view_slots: Option<u32>,
    /// Vulkan device whose name contains this.
    #[arg(long, help_heading = MEMORY)]
    device: Option<String>,

    /// Seed of everything random; the same seed on the same device gives the same model.
    #[arg(long, help_heading = RECIPE)]
    seed: Option<u64>,
    /// Prune what the loss needs least and train with quantised values, for `dgtr export --to delivery`.
    #[arg(long, value_enum, num_args = 0..=1, require_equals = true, default_missing_value = "coarse", help_heading = RECIPE)]
    for_delivery: Option<Fineness>,
    /// TOML file with any of the mission file's tables [training], [init], [refine], [network], [keyframes], [failsafe].
    #[arg(long, value_name = "FILE", help_heading = RECIPE)]
    settings: Option<PathBuf>,
}

/// What a card of pictures is read with.
#[derive(Debug, clap::Args)]
struct CardArgs {
    /// Positions of a card's pictures: OpenDroneMap's geo.txt, Mission Planner's list, geotags.csv of `dgtr fly`, a film's .SRT.
    #[arg(long, value_name = "FILE", help_heading = POSES)]
    geotags: Option<PathBuf>,
    /// The flight's log beside a card, MAVLink (.tlog) or ArduPilot (.BIN), matched by order and time.
    #[arg(long, value_name = "FILE", help_heading = POSES)]
    log: Option<PathBuf>,
    /// Surveyed points marked in a card's pictures; a gcp_list.txt beside them is found without this.
    #[arg(long, value_name = "FILE", help_heading = POSES)]
    gcp: Option<PathBuf>,
    /// Of a card with several bands or lenses the one of this name [default: natural colours].
    #[arg(long, value_name = "NAME", help_heading = PICTURES)]
    band: Option<String>,
    /// Surveyed points in a file of that form that measure the finished model instead of helping it.
    #[arg(long, value_name = "FILE", help_heading = POSES)]
    check: Option<PathBuf>,
}

impl CardArgs {
    fn options(self) -> Result<CardOptions, CliError> {
        Ok(CardOptions {
            geotags: self.geotags,
            control: self.gcp,
            check: self.check,
            exposures: self.log.as_deref().map(log::exposures).transpose()?.unwrap_or_default(),
            band: self.band,
        })
    }
}

/// Headings of the options.
const PICTURES: &str = "Pictures";
const POSES: &str = "Poses and places";
const START: &str = "First Gaussians";
const BUDGET: &str = "Time and energy";
const MEMORY: &str = "Memory and device";
const RECIPE: &str = "Recipe";

/// The recipe tables of a mission file.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    training: TrainSettings,
    init: InitSettings,
    refine: RefineSettings,
    network: NetworkSettings,
    keyframes: KeyframeSettings,
    failsafe: FailsafeSettings,
    coverage: CoverageSettings,
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
    for (name, value) in [("--seconds", args.seconds), ("--checkpoint-seconds", Some(args.checkpoint_seconds))] {
        if value.is_some_and(|v| !(v > 0.0 && v.is_finite())) {
            return Err(CliError::input(format!("{name} must be a positive number of seconds")));
        }
    }
    let mut settings = match &args.settings {
        None => Settings::default(),
        Some(path) => {
            let bad = |what: String| CliError::from(FormatError::Invalid { path: path.clone(), what });
            let bytes = read_bounded(path, SETTINGS_LIMIT)?;
            let text = String::from_utf8(bytes).map_err(|_| bad("not UTF-8 text".to_owned()))?;
            let mut settings: Settings = config::settings::parse(&text).map_err(|e| bad(e.to_string()))?;
            settings.network.anchor(path.parent().unwrap_or(Path::new("")));
            settings
        }
    };
    settings.keyframes.check()?;
    settings.failsafe.check()?;
    settings.coverage.check()?;
    if args.network.is_some() {
        settings.network.pair = args.network;
    }
    let training = &mut settings.training;
    training.seed = args.seed.unwrap_or(training.seed);
    (training.energy_wh, training.watts) = (args.energy_wh.or(training.energy_wh), args.watts.or(training.watts));
    training.check()?;
    let preset = args.preset.and_then(Preset::values);
    // A schedule in steps, in watt-hours or in a settings file is not cut short by a preset.
    let is_said = settings.training.seconds.is_some() || settings.training.energy_wh.is_some();
    let seconds = match args.steps.is_some() || is_said {
        true => args.seconds,
        false => args.seconds.or(preset.map(|p| p.seconds)),
    };
    let job = TrainJob {
        folders: args.folders,
        card: args.card.options()?,
        out: args.out,
        split: args.split,
        region: args.region,
        keyframes: args.keyframes.then_some(settings.keyframes),
        failsafe: args.failsafe.then_some(settings.failsafe),
        init: match args.init {
            _ if args.from.is_some() => InitKind::Model,
            Init::FeedForward => InitKind::FeedForward,
            Init::Sfm => InitKind::SparsePoints,
            Init::Random => InitKind::Random,
        },
        from: args.from,
        poses: match args.poses {
            Poses::Dataset => PoseSource::Dataset,
            Poses::Telemetry => PoseSource::Telemetry,
        },
        refine: !args.no_refine,
        for_delivery: args.for_delivery.map(Fineness::rounding),
        steps: args.steps,
        seconds,
        auto: args.preset == Some(Preset::Auto),
        budget_mib: args.budget_mib.or(preset.map(|p| p.device_mib)),
        max_gaussians: args.max_gaussians.or(preset.map(|p| p.max_gaussians as usize)),
        scene_gaussians: args.scene_gaussians,
        view_slots: args.view_slots,
        scale: args
            .scale
            .map(PictureScale::Exactly)
            .unwrap_or_else(|| preset.map_or(PictureScale::AsHeld, |p| PictureScale::OfJob(p.image_scale.into()))),
        device: args.device,
        network: settings.network,
        checkpoint_seconds: args.checkpoint_seconds,
        fresh: args.fresh,
        evaluate: !args.no_eval,
        training: settings.training,
        coverage: settings.coverage,
        init_settings: settings.init,
        refine_settings: settings.refine,
    };
    let ended = job.run()?;
    let model = job.model_path();
    if !ended.finished && !model.is_file() {
        return Err(CliError::interrupted(format!(
            "interrupted before there was a model in {}; the same command begins again",
            job.out.display()
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
    Ok(())
}
