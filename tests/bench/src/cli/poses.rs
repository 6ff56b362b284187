//! `bench poses`.

use std::path::PathBuf;

use config::refine::RefineSettings;
use pages::report::Table;

use crate::poses::measure;
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::figures::{markdown, short, write_json};

/// Arguments of `bench poses`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folders of cards.
    #[arg(required = true, value_name = "CARD")]
    pub cards: Vec<PathBuf>,
    /// True poses of the one card: a transforms.json whose pictures have the same names, endings aside.
    #[arg(long, value_name = "FILE")]
    pub reference: Option<PathBuf>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Runs `bench poses`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    if args.reference.is_some() && args.cards.len() > 1 {
        return Err(CliError::input("--reference is of one card; give one, or leave it out"));
    }
    let (mut rows, mut all) = (Vec::new(), Vec::new());
    for card in &args.cards {
        let (m, _) = measure(card, args.reference.as_deref(), &RefineSettings::default())?;
        let metres = |of: Option<[f64; 2]>| of.map_or("–".to_owned(), |[a, b]| format!("{a:.2} / {b:.2}"));
        let truth = |d: &crate::poses::Difference| {
            format!("{:.2} ({:.2} {}) / {:.2}°", d.rms_m, d.worst_m.0, d.worst_m.1, d.rms_deg)
        };
        rows.push(vec![
            card.display().to_string(),
            format!("{} of {}", m.tied, m.pictures),
            short(m.seconds),
            format!("{:.2} / {:.2}", m.reprojection_px[0], m.reprojection_px[1]),
            format!("{:.3}, {:.3}, {:.3}", m.lens[0], m.lens[1], m.lens[2]),
            metres(m.from_stated_m),
            m.from_reference.as_ref().map_or("–".to_owned(), truth),
            m.untied.iter().map(|(name, why)| format!("{name}: {why}")).collect::<Vec<_>>().join("; "),
        ]);
        all.push(m);
    }
    let head = [
        "card",
        "tied",
        "seconds",
        "rms / median px",
        "focal, k1, k2",
        "from stated, m",
        "from reference, m",
        "untied",
    ];
    let table = Table {
        title: "Poses of cards".into(),
        note: "Distances from stated positions are of the nearer nine tenths, horizontal and vertical; from a reference after a similarity, with the worst.".into(),
        head: head.map(str::to_owned).to_vec(),
        rows,
    };
    outln!("{}", markdown(&table));
    if let Some(path) = &args.json {
        write_json(path, &all)?;
    }
    Ok(())
}
