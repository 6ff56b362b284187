//! `dgtr ground cell KEY… --store STORE`.

use std::str::FromStr;

use config::keys::to_hex;
use ground::AggregateError;
use ground::jobs::{join, make};
use ground::plan::Plan;
use ground::store::Store;
use job::interrupt::Interrupt;
use models::ground_cell::CellKey;

use super::CliError;
use crate::cli::ending::within_bounds;
use crate::cli::output::outln;

/// Arguments of `dgtr ground cell`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Cells of the plan, LEVEL/X/Y as `dgtr ground plan` prints them.
    #[arg(required_unless_present_any = ["all", "share"])]
    keys: Vec<CellKey>,
    /// The folder or bucket that has the plan.
    #[arg(long)]
    store: String,
    /// All cells of the plan.
    #[arg(long, conflicts_with_all = ["keys", "share"])]
    all: bool,
    /// Every N-th cell of the plan from the I-th on, I from 0 to N − 1: the share of one of N jobs of an array.
    #[arg(long, value_name = "I/N", conflicts_with = "keys")]
    share: Option<Share>,
    /// Device by (part of) its name: processor, or a Vulkan device.
    #[arg(long)]
    device: Option<String>,
}

/// One of so many.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Share {
    index: usize,
    of: usize,
}

impl FromStr for Share {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        let share = numbers.map(|(index, of)| Self { index, of }).filter(|s| s.index < s.of);
        share.ok_or_else(|| "must be I/N with I from 0 to N − 1, as in 0/4".to_owned())
    }
}

pub(super) fn run(args: Args) -> Result<(), CliError> {
    let stop = Interrupt::install()?;
    within_bounds(&stop).map_err(CliError::failed)?;
    let store = Store::open(&args.store)?;
    let plan = Plan::of(&store)?;
    let index = |key: &CellKey| {
        let found = plan.cells.binary_search_by_key(key, |c| c.key);
        found.map_err(|_| AggregateError::NoCell(key.to_string()))
    };
    let wanted: Vec<usize> = match args.share {
        Some(Share { index, of }) => (index..plan.cells.len()).step_by(of).collect(),
        None if args.all => (0..plan.cells.len()).collect(),
        None => args.keys.iter().map(index).collect::<Result<_, _>>()?,
    };
    for i in wanted {
        let cell = &plan.cells[i];
        let inputs = plan.inputs(cell);
        if inputs.hash()? != cell.input {
            return Err(AggregateError::OtherCell(cell.key.to_string()).into());
        }
        let was_there = join::sound(&store, &plan, &cell.input)?;
        let is_new = was_there.is_none();
        let head = match was_there {
            Some(head) => head,
            None => match make::make(&inputs, &store, args.device.as_deref(), &|| stop.requested())? {
                Some(made) => made.head,
                None => return Err(CliError::interrupted("stopped on request; run the same command again")),
            },
        };
        let how = if is_new { "made" } else { "was there" };
        outln!("{} {} {} Gaussians, {how}", cell.key, to_hex(&head.content), head.count);
        if stop.requested() {
            return Err(CliError::interrupted("stopped on request; run the same command again"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_is_one_of_so_many() {
        assert_eq!("1/3".parse(), Ok(Share { index: 1, of: 3 }));
        for bad in ["3/3", "1", "-1/3", "0/0", "a/b"] {
            assert!(bad.parse::<Share>().is_err(), "{bad}");
        }
    }
}
