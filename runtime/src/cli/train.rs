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
use crate::train_job::{TrainJob, log};

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
    /// Folder of posed pictures (nerfstudio, COLMAP, OpenDroneMap), or folders of a camera's card (DCIM) with pictures that
    /// say where they were taken.
    #[arg(required = true, value_name = "FOLDER")]
    pub folders: Vec<PathBuf>,
    /// Positions of a card's pictures: geo.txt of OpenDroneMap, Mission Planner's list, geotags.csv of `dgtr fly`.
    #[arg(long, value_name = "FILE")]
    geotags: Option<PathBuf>,
    /// Surveyed points marked in a card's pictures: gcp_list.txt of OpenDroneMap (found by that name without this).
    #[arg(long, value_name = "FILE")]
    gcp: Option<PathBuf>,
    /// Other surveyed points, in a file of that form, that are not used: how far the finished model's renderings put them off.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
    /// The flight's log beside a card: MAVLink (.tlog) or ArduPilot (.BIN), matched to the pictures by order and time.
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// Where the model (model.dgtr) and run.json go; an unfinished model there is continued.
    #[arg(long)]
    pub out: PathBuf,
    /// Which pictures (a list of split.json; without that file every 8th is held out).
    #[arg(long, default_value = "train")]
    split: String,
    /// Only the pictures of this region.
    #[arg(long)]
    region: Option<String>,
    /// Only key frames by the rule of a flight: [keyframes] of --settings, or its defaults.
    #[arg(long)]
    keyframes: bool,
    /// Spare this computer as a flight does when it is hot or throttled or its supply is weak, and warn of a full disk:
    /// [failsafe] of --settings, or its defaults. The same seed then gives another model where it had to.
    #[arg(long)]
    failsafe: bool,
    /// Where the first Gaussians come from.
    #[arg(long, value_enum, default_value = "feed-forward")]
    init: Init,
    /// The first Gaussians are those of this model, in the frame of the data set, however many: those that find no room on the device wait
    /// in a file in --out, and none are ever all in memory. The schedule begins anew.
    #[arg(long, value_name = "MODEL", conflicts_with = "init")]
    from: Option<PathBuf>,
    /// Where camera poses come from.
    #[arg(long, value_enum, default_value = "dataset")]
    poses: Poses,
    /// Take telemetry poses as they are.
    #[arg(long)]
    no_refine: bool,
    /// Give up the Gaussians that the loss hangs on least ([training] thinned_share) and train the last share of the schedule with values
    /// as the delivery encoding rounds them (rounded_share): for models that go out by `dgtr export --to delivery`.
    #[arg(long, value_enum, num_args = 0..=1, require_equals = true, default_missing_value = "coarse")]
    for_delivery: Option<Fineness>,
    /// Optimiser steps; with neither --steps nor --seconds the recipe's own number ([training] steps, or
    /// [training.views] visits to each picture where those are fewer).
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..))]
    steps: Option<u32>,
    /// Seconds of training; with --steps, whichever comes first.
    #[arg(long)]
    seconds: Option<f64>,
    /// Watt-hours that training may take; with --steps or --seconds, whichever comes first. Power is what the board says (hwmon,
    /// vcgencmd) or --watts.
    #[arg(long)]
    energy_wh: Option<f64>,
    /// Watts that this computer takes while it trains, where it does not say so itself.
    #[arg(long, requires = "energy_wh")]
    watts: Option<f32>,
    /// Budgets of a size of job, for whatever of --budget-mib, --max-gaussians, --scale and --seconds is not given.
    #[arg(long, value_parser = presets())]
    preset: Option<Preset>,
    /// Device memory, MiB, allocated once [default: 512].
    #[arg(long)]
    budget_mib: Option<u32>,
    /// Most Gaussians on the device; default: what the budget holds.
    #[arg(long)]
    max_gaussians: Option<usize>,
    /// Gaussians of the whole scene, when they are more than those on the device; the others wait in a file in --out.
    #[arg(long, value_name = "N")]
    scene_gaussians: Option<usize>,
    /// Pictures on the device at once, the others waiting in a file in --out [default: all while they leave half of the budget].
    #[arg(long, value_name = "N")]
    view_slots: Option<u32>,
    /// Image scale, above 0 and at most 1 [default: as large as the budget holds].
    #[arg(long)]
    scale: Option<f64>,
    /// Seed of everything random; same seed and device, same model.
    #[arg(long)]
    seed: Option<u64>,
    /// Vulkan device whose name contains this.
    #[arg(long)]
    device: Option<String>,
    /// Manifest of your own feed-forward network.
    #[arg(long = "model", value_name = "FILE")]
    network: Option<PathBuf>,
    /// TOML file with any of the mission file's tables [training], [init], [refine], [network],
    /// [keyframes], [failsafe].
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 30.0)]
    checkpoint_seconds: f64,
    /// Forget a model that is already in --out.
    #[arg(long)]
    fresh: bool,
    /// Do not score the split `test` at the end.
    #[arg(long)]
    no_eval: bool,
}

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
        card: CardOptions {
            geotags: args.geotags,
            control: args.gcp,
            check: args.check,
            exposures: args.log.as_deref().map(log::exposures).transpose()?.unwrap_or_default(),
        },
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
        scale: args.scale.or(preset.map(|p| p.image_scale.into())),
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
