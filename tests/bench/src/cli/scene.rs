//! `bench scene`.

use std::path::PathBuf;

use pages::report::{Table, bytes, count};

use crate::scene::{Figures, Request, measure};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::error::JobError;
use runtime::figures::{markdown, short, write_json};

/// Arguments of `bench scene`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Gaussians of the made-up scene.
    #[arg(long, default_value_t = 1_000_000, value_parser = clap::value_parser!(u32).range(1..=100_000_000))]
    pub gaussians: u32,
    /// Their SH degree.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(0..=3))]
    pub sh_degree: u8,
    /// Steps of training.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    pub steps: u32,
    /// Device memory, MiB. On a software device it is the process's own: give --limit-mib so much more.
    #[arg(long, default_value_t = 512)]
    pub device_mib: u32,
    /// Where the made-up scene (scene.dgtr), the trained one (model.dgtr) and its pictures go.
    #[arg(long)]
    pub out: PathBuf,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Runs `bench scene`.
///
/// # Errors
/// Whatever ends the command; a picture that is not the unpaged one's.
pub fn run(args: Args) -> Result<(), CliError> {
    let request = Request {
        gaussians: args.gaussians as usize,
        sh_degree: args.sh_degree,
        steps: args.steps,
        device_mib: args.device_mib,
        device: args.device,
    };
    let all = measure(&request, &args.out)?;
    outln!("{}", markdown(&table(&all)));
    if let Some(path) = &args.json {
        write_json(path, &all)?;
    }
    match all.drawn.iter().find(|drawn| drawn.same == Some(false)) {
        Some(drawn) => {
            let what = "is another picture than a trainer draws that has all of it on the device";
            Err(JobError::System(format!("{}: {what}", drawn.path.display())).into())
        }
        None => Ok(()),
    }
}

fn table(all: &Figures) -> Table {
    let own = all.resident_bytes.saturating_sub(if all.shared { all.device_bytes[1] } else { 0 });
    let planned = all.host_bytes_planned.saturating_sub(if all.shared { all.device_bytes[1] } else { 0 });
    let [written, loaded, trained, saved] = all.seconds;
    let mut rows = vec![
        ["Gaussians, and at once on the device".into(), all.gaussians.map(|n| count(n as u64)).join(", ")],
        ["cells, and windows of them trained".into(), all.cells.map(|n| n.to_string()).join(", ")],
        ["the scene's file, and read and written of it".into(), all.file_bytes.map(bytes).join(", ")],
        ["device, planned and allocated".into(), all.device_bytes.map(bytes).join(", ")],
        ["host without it, planned and at the most".into(), [planned, own].map(bytes).join(", ")],
        ["largest resident set".into(), bytes(all.resident_bytes)],
        ["the made-up scene written".into(), format!("{} s", short(written))],
        ["into the cells".into(), format!("{} s", short(loaded))],
        [format!("{} steps", all.steps), format!("{} s", short(trained))],
        ["saved".into(), format!("{} s", short(saved))],
    ];
    for drawn in &all.drawn {
        let same = match drawn.same {
            Some(true) => "the unpaged one to the bit",
            Some(false) => "NOT the unpaged one",
            None => "more than any device holds: not compared",
        };
        let name = drawn.path.file_name().unwrap_or_default().to_string_lossy();
        let seen = count(drawn.seen as u64);
        rows.push([format!("{name}, of {seen} Gaussians"), format!("{} s, {same}", short(drawn.seconds))]);
    }
    Table {
        title: "A scene larger than the device and the host".into(),
        note: format!("Drawn on {}.", all.device),
        head: ["what", "figures"].map(str::to_owned).to_vec(),
        rows: rows.into_iter().map(Vec::from).collect(),
    }
}
