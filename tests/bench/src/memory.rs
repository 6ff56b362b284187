//! What a memory budget really costs and buys: planned against allocated and resident bytes, and held-out quality, each
//! budget in a process of its own that may not write to more than its limit.

use std::path::Path;

use pages::report::{Table, bytes, count};
use serde::Serialize;

use super::child;
use runtime::error::JobError;
use runtime::figures::short;

/// How every budget is trained.
#[derive(Clone, Debug)]
pub struct Recipe {
    /// Arguments of `dgtr train` besides the budget: data set, `--init`, `--seconds` or `--steps`, `--seed`.
    pub train: Vec<String>,
    /// Bytes the host may use besides the budget, MiB.
    pub host_mib: u64,
}

/// One budget.
#[derive(Clone, Debug, Serialize)]
pub struct BudgetFigures {
    /// Device memory allowed, MiB.
    pub budget_mib: u32,
    /// Bound on what the process may write to (RLIMIT_DATA), MiB.
    pub limit_mib: u64,
    /// Bytes of the plan.
    pub planned_bytes: u64,
    /// Bytes allocated on the device.
    pub allocated_bytes: u64,
    /// Largest resident set of the process (VmHWM); on a software device this contains the device's bytes.
    pub resident_bytes: u64,
    /// Gaussians in the model.
    pub gaussians: u64,
    /// Optimiser steps.
    pub steps: u64,
    /// Held-out PSNR, dB.
    pub psnr: Option<f64>,
    /// Held-out SSIM.
    pub ssim: Option<f64>,
    /// Why there are no figures.
    pub failed: Option<String>,
}

impl BudgetFigures {
    /// Planned and allocated agree to the byte, and nothing exceeded its bound.
    pub fn kept(&self) -> bool {
        self.failed.is_none()
            && self.planned_bytes == self.allocated_bytes
            && self.allocated_bytes <= u64::from(self.budget_mib) << 20
    }
}

/// Trains with `budget_mib` of device memory in a child of its own under `out`.
///
/// # Errors
/// No device, or stopped on request.
pub fn measure(budget_mib: u32, recipe: &Recipe, out: &Path) -> Result<BudgetFigures, JobError> {
    let limit_mib = u64::from(budget_mib) + recipe.host_mib;
    let mut arguments = vec!["train".to_owned()];
    arguments.extend(recipe.train.iter().cloned());
    arguments.extend(["--budget-mib".to_owned(), budget_mib.to_string(), "--fresh".to_owned()]);
    let ended = child::run(&arguments, &out.join(format!("{budget_mib}mib")), Some(limit_mib))?;
    let failed = ended.report.is_none().then_some(ended.last_line);
    let r = ended.report.unwrap_or_default();
    Ok(BudgetFigures {
        budget_mib,
        limit_mib,
        planned_bytes: r.memory.device_bytes_planned,
        allocated_bytes: r.memory.device_bytes_peak,
        resident_bytes: r.memory.host_rss_peak,
        gaussians: r.gaussians,
        steps: r.steps,
        psnr: r.psnr,
        ssim: r.ssim,
        failed,
    })
}

/// One row per budget; `shared` says that the device's memory is the host's, so that the host's own part can be told.
pub fn table(budgets: &[BudgetFigures], shared: bool) -> Table {
    let dash = || "–".to_owned();
    let row = |b: &BudgetFigures| {
        let mut cells = vec![format!("{} MiB", b.budget_mib)];
        if let Some(why) = &b.failed {
            cells.extend((0..9).map(|_| dash()));
            cells.push(why.split([';', '(']).next().unwrap_or(why).trim().to_owned());
            return cells;
        }
        let own = b.resident_bytes.saturating_sub(if shared { b.allocated_bytes } else { 0 });
        cells.extend([
            bytes(b.planned_bytes),
            bytes(b.allocated_bytes),
            bytes(b.resident_bytes),
            bytes(own),
            format!("{} MiB", b.limit_mib),
            count(b.gaussians),
            b.steps.to_string(),
            b.psnr.map_or_else(dash, |v| format!("{v:.2}")),
            b.ssim.map_or_else(dash, |v| format!("{v:.3}")),
            if b.kept() { "as planned".into() } else { "NOT as planned".into() },
        ]);
        cells
    };
    let head = [
        "budget",
        "planned",
        "allocated",
        "resident",
        "host's own",
        "limit",
        "Gaussians",
        "steps",
        "PSNR, dB",
        "SSIM",
        "outcome",
    ];
    let worst =
        budgets.iter().filter(|b| b.failed.is_none()).map(|b| b.allocated_bytes as f64 / b.planned_bytes as f64);
    let note = match worst.reduce(f64::max) {
        Some(ratio) => format!("Allocated over planned, at worst: {}.", short(ratio)),
        None => String::new(),
    };
    Table {
        title: "Memory".into(),
        note,
        head: head.map(String::from).to_vec(),
        rows: budgets.iter().map(row).collect(),
    }
}
