//! `bench sparse DATASET…`.

use std::path::PathBuf;

use super::Init;
use super::recipe::Recipe;
use crate::sparse::{Request, measure, table};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::figures::{markdown, write_json};

/// Arguments of `bench sparse`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folders of posed pictures with held-out ones.
    #[arg(required = true)]
    pub datasets: Vec<PathBuf>,
    /// Folder for the thinned sets, their models and result.json; trainings already there are kept.
    #[arg(long)]
    pub out: PathBuf,
    /// Of how many training pictures one is kept, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "1,2,3,5", value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=1000))]
    pub every: Vec<usize>,
    /// Seeds, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "1,2,3")]
    pub seeds: Vec<u64>,
    /// Where the first Gaussians come from, separated by commas.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "feed-forward")]
    init: Vec<Init>,
    /// The list of training pictures that is thinned.
    #[arg(long, default_value = "train")]
    pub split: String,
    /// Optimiser steps.
    #[arg(long, default_value_t = 2000)]
    pub steps: u32,
    /// Device memory, MiB.
    #[arg(long, default_value_t = 512)]
    pub budget_mib: u32,
    /// What every training has alike.
    #[command(flatten)]
    pub recipe: Recipe,
    /// Train anew what is already in --out.
    #[arg(long)]
    pub again: bool,
}

/// Runs `bench sparse`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let mut train = args.recipe.arguments();
    for (flag, value) in [("--steps", args.steps), ("--budget-mib", args.budget_mib)] {
        train.extend([flag.to_owned(), value.to_string()]);
    }
    let request = Request {
        datasets: args.datasets,
        every: args.every,
        seeds: args.seeds,
        inits: args.init.iter().map(|i| i.flag()).collect(),
        split: args.split,
        train,
        out: args.out.clone(),
        again: args.again,
    };
    let points = measure(&request, &mut |p| {
        tracing::info!("{} {} pictures, {} seed {}: {:.2} dB", p.dataset, p.pictures, p.init, p.seed, p.psnr);
    })?;
    outln!("{}", markdown(&table(&points)));
    write_json(&args.out.join("result.json"), &points)?;
    Ok(())
}
