//! Where the reference data lies: a user's clone has none of it. Tests of all crates include this file by its path.

use std::path::{Path, PathBuf};

/// A file or folder of the reference data (`../shared`, or where `DGTR_DATA` says); without it, says so.
pub fn shared(path: &str) -> Option<PathBuf> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().find(|folder| folder.join("Cargo.lock").exists());
    let beside = workspace.map(|folder| folder.join("../shared"));
    let root = std::env::var_os("DGTR_DATA").map(PathBuf::from).or(beside).unwrap_or_default();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(root).join(path);
    if !path.exists() {
        println!("skipped: {} is not there (DGTR_DATA names the folder that holds data/ and models/)", path.display());
    }
    path.exists().then_some(path)
}
