//! What all trainings of a measurement have alike.

use std::path::PathBuf;

/// Options of `dgtr train` that every training of a measurement is given.
#[derive(Debug, clap::Args)]
pub struct Recipe {
    /// Image scale, above 0 and at most 1.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f64,
    /// Most Gaussians.
    #[arg(long)]
    pub max_gaussians: Option<usize>,
    /// TOML file with recipe tables for every training, as `dgtr train --settings`.
    #[arg(long, value_name = "FILE")]
    pub settings: Option<PathBuf>,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
}

impl Recipe {
    /// As `dgtr train` takes them.
    pub fn arguments(&self) -> Vec<String> {
        let mut train = vec!["--scale".to_owned(), self.scale.to_string()];
        let given = [
            ("--max-gaussians", self.max_gaussians.map(|n| n.to_string())),
            ("--settings", self.settings.as_ref().map(|path| path.display().to_string())),
            ("--device", self.device.clone()),
        ];
        for (flag, value) in given {
            train.extend(value.into_iter().flat_map(|value| [flag.to_owned(), value]));
        }
        train
    }
}
