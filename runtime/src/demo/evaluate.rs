//! Figures of the demo: every model against held-out views of the ray-cast world, by the program's own `dgtr eval`.

use std::path::{Path, PathBuf};
use std::process::Command;

use job::interrupt::Interrupt;
use serde::Deserialize;

use super::{AIRCRAFT, DemoError, DemoOptions};

/// What `dgtr eval --json --baselines` prints, as far as the demo shows it.
#[derive(Clone, Debug, Deserialize)]
pub struct Scores {
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Gaussians of the model.
    pub gaussians: u64,
    /// Optimiser steps.
    pub steps: u64,
    /// Each view.
    pub views: Vec<ViewScore>,
    /// The naive guesses.
    pub baselines: Option<Naive>,
}

/// One view.
#[derive(Clone, Debug, Deserialize)]
pub struct ViewScore {
    /// Picture.
    pub name: String,
    /// dB.
    pub psnr: f64,
}

/// The naive guesses.
#[derive(Clone, Debug, Deserialize)]
pub struct Naive {
    /// Nearest training picture over flat ground.
    pub ground_warp: Mean,
    /// Mean colour.
    pub mean_color: Mean,
}

/// A mean over views.
#[derive(Clone, Debug, Deserialize)]
pub struct Mean {
    /// dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
}

/// One aircraft's held-out views, through its own and through the global model.
#[derive(Clone, Debug)]
pub struct Figures {
    /// Aircraft.
    pub name: &'static str,
    /// Its own model.
    pub local: Scores,
    /// The global model on the same views.
    pub global: Scores,
    /// Data set with the truth.
    pub truth: PathBuf,
    /// Renderings of the local model.
    pub renderings: [PathBuf; 2],
}

/// Scores all models on all held-out views.
///
/// # Errors
/// A model or picture cannot be read or rendered.
pub fn all(out: &Path, options: &DemoOptions, interrupt: &Interrupt) -> Result<Vec<Figures>, DemoError> {
    let global = out.join("ground/out/global.dgtr");
    let mut figures = Vec::new();
    for name in AIRCRAFT {
        if interrupt.requested() {
            return Err(DemoError::Interrupted(out.into()));
        }
        let truth = out.join(name).join("truth");
        let renderings = [out.join(name).join("rendered"), out.join("ground/rendered").join(name)];
        let local = eval(&out.join(name).join("out/model.dgtr"), &truth, &renderings[0], true, options)?;
        let global = eval(&global, &truth, &renderings[1], false, options)?;
        figures.push(Figures { name, local, global, truth, renderings });
    }
    Ok(figures)
}

fn eval(model: &Path, truth: &Path, save: &Path, naive: bool, options: &DemoOptions) -> Result<Scores, DemoError> {
    let failed = |what: String| DemoError::Report(format!("dgtr eval {}: {what}", model.display()));
    let program = std::env::current_exe().map_err(|e| failed(e.to_string()))?;
    let mut command = Command::new(program);
    command.arg("--limit-mib").arg(options.limit_mib.to_string()).arg("eval").arg(model).arg(truth);
    command.args(["--split", "test", "--json", "--save"]).arg(save);
    if naive {
        command.arg("--baselines");
    }
    let output = command.output().map_err(|e| failed(e.to_string()))?;
    if !output.status.success() {
        return Err(failed(String::from_utf8_lossy(&output.stderr).trim().to_owned()));
    }
    serde_json::from_slice(&output.stdout).map_err(|e| failed(e.to_string()))
}
