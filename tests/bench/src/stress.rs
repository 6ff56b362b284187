//! The numerical promises of `vulkan::cases`, tried on the device that is there and on the CPU reference.

use serde::Serialize;
use vulkan::cases::{CASES, ELSEWHERE, Outcome, extremes};
use vulkan::gpu::Gpu;

use pages::report::Table;

/// One case on one path.
#[derive(Clone, Debug, Serialize)]
pub struct Tried {
    /// What came in.
    pub input: &'static str,
    /// What was promised.
    pub promise: &'static str,
    /// `device` or `reference`.
    pub path: &'static str,
    /// Whether the promise held.
    pub held: bool,
    /// What was counted, or how it was broken.
    pub outcome: String,
}

fn tried(input: &'static str, promise: &'static str, path: &'static str, outcome: Outcome) -> Tried {
    let held = outcome.is_ok();
    Tried { input, promise, path, held, outcome: outcome.unwrap_or_else(|e| e.to_string()) }
}

/// Tries every case, `each` after every one; without a device only the reference's. `long_steps` above 0 adds a long run.
pub fn run(gpu: Option<&Gpu>, long_steps: u32, each: &mut dyn FnMut(&Tried)) -> Vec<Tried> {
    let mut all = Vec::new();
    let mut add = |one: Tried| {
        each(&one);
        all.push(one);
    };
    for case in CASES {
        if let (Some(gpu), Some(f)) = (gpu, case.device) {
            add(tried(case.input, case.promise, "device", f(gpu)));
        }
        if let Some(f) = case.reference {
            add(tried(case.input, case.promise, "reference", f()));
        }
    }
    if let (Some(gpu), true) = (gpu, long_steps > 0) {
        let promise = "no NaN, mean opacity neither at 0 nor at 1";
        add(tried("a long run", promise, "device", extremes::long_run(gpu, long_steps)));
    }
    all
}

/// One row per case and path.
pub fn table(all: &[Tried]) -> Table {
    let row = |t: &Tried| {
        let held = if t.held { "held" } else { "BROKEN" };
        [t.input, t.promise, t.path, held, t.outcome.as_str()].map(String::from).to_vec()
    };
    Table {
        title: "Numerical promises".into(),
        note: format!("{} of {} held.", all.iter().filter(|t| t.held).count(), all.len()),
        head: ["what comes in", "promise", "path", "outcome", "counted"].map(String::from).to_vec(),
        rows: all.iter().map(row).collect(),
    }
}

/// The cases that tests of other parts hold.
pub fn elsewhere() -> Table {
    Table {
        title: "Promises of other parts".into(),
        note: "Tried by the test suite.".into(),
        head: ["what comes in", "file", "test"].map(String::from).to_vec(),
        rows: ELSEWHERE.iter().map(|(input, file, name)| [*input, *file, *name].map(String::from).to_vec()).collect(),
    }
}
