//! Programs of other implementations, in a Python environment of their own below `target/`.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};

/// One test installs, the others wait for it.
static SETUP: Mutex<()> = Mutex::new(());

/// Python in an environment called `name` with `packages`, of which `imports` can be imported; `None` where this machine lacks that.
pub fn with(name: &str, packages: &[&str], imports: &str) -> Option<PathBuf> {
    let _guard = SETUP.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let python = folder.join("bin/python");
    let run = |program: &Path, arguments: &[&str]| {
        let status = Command::new(program).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status();
        status.is_ok_and(|s| s.success())
    };
    let works = || run(&python, &["-c", &format!("import {imports}")]);
    let target = folder.to_string_lossy().into_owned();
    let install: Vec<&str> = ["-m", "pip", "install", "--quiet"].into_iter().chain(packages.iter().copied()).collect();
    if works() || (run(Path::new("python3"), &["-m", "venv", &target]) && run(&python, &install) && works()) {
        return Some(python);
    }
    needs::missing(
        needs::Need::PythonPackages,
        format!("{} cannot be installed here (needs python3 with venv, and a package index)", packages.join(" ")),
    );
    None
}
