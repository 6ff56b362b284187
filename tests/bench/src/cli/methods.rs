//! `bench methods`.

use std::path::PathBuf;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use job::interrupt::Interrupt;

use crate::methods::presets::{METHODS, Method};
use crate::methods::{Networks, Onboard, Request, measure, survey, table};
use runtime::cli::CliError;
use runtime::cli::output::{out, outln};
use runtime::figures::{markdown, write_json, write_text};

/// Most regions that a data set is divided into.
const MOST_REGIONS: u64 = 256;

/// Arguments of `bench methods`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of posed pictures, with sparse points for the methods that begin with them.
    #[arg(required_unless_present = "simulated", conflicts_with = "simulated")]
    pub dataset: Option<PathBuf>,
    /// Instead: a simulated survey of so many aircraft.
    #[arg(long, value_name = "N")]
    pub simulated: Option<usize>,
    /// Folder for models, figures and tables; what is there for the same settings is not done again.
    #[arg(long, default_value = "methods")]
    pub out: PathBuf,
    /// Divide the pictures into so many regions of equally many [default: the data set's own regions, else 4].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=MOST_REGIONS))]
    pub regions: Option<u64>,
    /// Which pictures to train on (a list of split.json).
    #[arg(long, default_value = "train")]
    pub split: String,
    /// Steps of each aircraft; a model on the ground has as many times that as there are aircraft [default: 1000].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub steps: Option<u32>,
    /// Seconds of training of each aircraft; with --steps, whichever comes first.
    #[arg(long)]
    pub seconds: Option<f64>,
    /// Methods, separated by commas [default: all but the ablations].
    #[arg(long, value_delimiter = ',', value_parser = methods())]
    pub methods: Vec<&'static Method>,
    #[command(flatten)]
    pub onboard: Onboard,
    /// Size of the pictures, above 0 and at most 1, in training and comparison.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f64,
    /// Seed of the survey and of the training.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    #[command(flatten)]
    pub networks: Networks,
    /// Do again what is in --out already.
    #[arg(long)]
    pub again: bool,
    /// The figures as one JSON object on standard output, instead of the tables.
    #[arg(long)]
    pub json: bool,
}

/// Steps of each aircraft where neither steps nor seconds are given.
const STEPS: u32 = 1000;

/// The methods as clap shows them.
fn methods() -> impl TypedValueParser<Value = &'static Method> {
    let named = METHODS.iter().map(|m| PossibleValue::new(m.name).help(m.what));
    PossibleValuesParser::new(named.collect::<Vec<_>>()).try_map(|name| Method::named(&name).ok_or("no such method"))
}

/// Runs `bench methods`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    if args.seconds.is_some_and(|s| !(s > 0.0 && s.is_finite())) {
        return Err(CliError::input("--seconds must be a positive number of seconds"));
    }
    if !(args.scale > 0.0 && args.scale <= 1.0) {
        return Err(CliError::input(format!("--scale {} must be above 0 and at most 1", args.scale)));
    }
    let stop = Interrupt::install()?;
    let data = match (args.dataset, args.simulated) {
        (Some(data), _) => data,
        (None, aircraft) => {
            let aircraft = aircraft.unwrap_or_default();
            let data = args.out.join(format!("simulated-{aircraft}"));
            survey::write(&data, aircraft, args.seed)?;
            data
        }
    };
    let chosen = if args.methods.is_empty() { METHODS.iter().filter(|m| !m.ablation).collect() } else { args.methods };
    let request = Request {
        data,
        out: args.out,
        split: args.split,
        regions: args.regions.map(|n| n as usize),
        steps: args.steps.or(args.seconds.is_none().then_some(STEPS)),
        seconds: args.seconds,
        onboard: args.onboard,
        scale: args.scale,
        seed: args.seed,
        methods: chosen,
        networks: args.networks,
        again: args.again,
    };
    let comparison = measure(&request, &|| stop.requested(), &mut |m| {
        if let Some(all) = &m.quality.all {
            tracing::info!("{}: {:.2} dB, {:.2} with colours fitted", m.method, all.psnr, all.psnr_colors_fitted);
        }
    })?;
    let text = table::tables(&comparison).iter().map(markdown).collect::<Vec<_>>().join("\n");
    write_json(&request.out.join("methods.json"), &comparison)?;
    write_text(&request.out.join("methods.md"), &text)?;
    if args.json {
        outln!("{}", serde_json::to_string(&comparison).map_err(CliError::failed)?);
    } else {
        out!("{text}");
    }
    Ok(())
}
