//! `bench stages [DATASET]`.

use std::path::PathBuf;

use pages::report::Table;
use tuning::kernels;
use vulkan::gpu::Gpu;
use vulkan::roofline;

use crate::csv::csv;
use crate::stages::{growth, growth_table, of_dataset, overview_table, size_table};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::device_report::stages::{Scene, SizeFigures, measure};
use runtime::figures::{markdown, short, write_json, write_text};

/// Arguments of `bench stages`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Train this data set's pictures from its sparse points instead of synthetic scenes.
    pub dataset: Option<PathBuf>,
    /// Image scale, with DATASET, above 0 and at most 1.
    #[arg(long, default_value_t = 1.0, requires = "dataset")]
    pub scale: f64,
    /// Numbers of Gaussians, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "10000,100000,500000", conflicts_with = "dataset")]
    pub gaussians: Vec<usize>,
    /// Picture sizes, WIDTHxHEIGHT separated by commas.
    #[arg(
        long, value_delimiter = ',', default_value = "270x480,640x480,1280x720",
        value_parser = size, conflicts_with = "dataset"
    )]
    pub sizes: Vec<(u32, u32)>,
    /// Steps that are measured at each size.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    pub steps: u32,
    /// Seed of the synthetic scenes.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write one line per stage and size as CSV.
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
}

/// `640x480`.
fn size(text: &str) -> Result<(u32, u32), String> {
    let parts = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    match parts {
        Some((w, h)) if w > 0 && h > 0 => Ok((w, h)),
        _ => Err(format!("'{text}' is not WIDTHxHEIGHT")),
    }
}

/// Runs `bench stages`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let gpu = Gpu::open(args.device.as_deref())?;
    let config = kernels::config_of(&gpu);
    let roofline = roofline::measure(&gpu)?;
    outln!(
        "{}: copies {} GB/s by a kernel and {} GB/s by command (read + written), computes {} G operations/s; kernels {}x{}\n",
        gpu.info().name,
        short(roofline.kernel_bytes_per_s * 1e-9),
        short(roofline.command_bytes_per_s * 1e-9),
        short(roofline.operations_per_s * 1e-9),
        config.wide,
        config.narrow
    );
    let mut sizes = Vec::new();
    let mut add = |scene: &Scene| -> Result<(), CliError> {
        let figures = measure(&gpu, config, &roofline, scene, args.steps)?;
        outln!("{}", markdown(&size_table(&figures)));
        sizes.push(figures);
        Ok(())
    };
    match &args.dataset {
        Some(root) => add(&of_dataset(root, args.scale)?)?,
        None => {
            for &(w, h) in &args.sizes {
                for &n in &args.gaussians {
                    add(&Scene::synthetic(n, w, h, args.seed))?;
                }
            }
        }
    }
    let grown = growth(&sizes);
    outln!("{}", markdown(&overview_table(&sizes)));
    // One size has no slope.
    if sizes.len() > 1 {
        outln!("{}", markdown(&growth_table(&grown)));
    }
    if let Some(path) = &args.csv {
        write_text(path, &csv(&flat(&sizes)))?;
    }
    if let Some(path) = &args.json {
        let all = serde_json::json!({
            "device": gpu.info().name,
            "kernels": { "wide": config.wide, "narrow": config.narrow },
            "kernel_bytes_per_s": roofline.kernel_bytes_per_s,
            "command_bytes_per_s": roofline.command_bytes_per_s,
            "operations_per_s": roofline.operations_per_s,
            "sizes": sizes,
            "growth": if sizes.len() > 1 { grown } else { Vec::new() },
        });
        write_json(path, &all)?;
    }
    Ok(())
}

/// One row per size and stage, unrounded.
fn flat(sizes: &[SizeFigures]) -> Table {
    let mut rows = Vec::new();
    for s in sizes {
        for stage in &s.stages {
            rows.push(vec![
                s.scene.clone(),
                s.width.to_string(),
                s.height.to_string(),
                s.gaussians.to_string(),
                s.visible.to_string(),
                s.instances.to_string(),
                s.evaluations.to_string(),
                stage.stage.to_owned(),
                stage.ms.to_string(),
                stage.bytes.to_string(),
                stage.operations.to_string(),
                stage.least_ms.to_string(),
            ]);
        }
    }
    let head = [
        "scene",
        "width",
        "height",
        "gaussians",
        "visible",
        "instances",
        "evaluations",
        "stage",
        "ms",
        "bytes",
        "operations",
        "least_ms",
    ];
    Table { head: head.map(String::from).to_vec(), rows, ..Table::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_two_numbers_with_an_x() {
        assert_eq!(size("640x480"), Ok((640, 480)));
        assert!(size("640").is_err() && size("0x3").is_err() && size("axb").is_err());
    }
}
