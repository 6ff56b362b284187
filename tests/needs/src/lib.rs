//! What tests need of a machine. A missing device, library or tool fails a test, so that a broken driver is not green. `DGTR_SKIP`, a list
//! of names with commas, lets tests pass that need those; `tests/run.sh` sets it to what the machine lacks and says so.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Something that tests need and a machine may lack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// A Vulkan device; Mesa's software driver is one.
    Vulkan,
    /// Khronos' validation layer.
    ValidationLayer,
    /// ONNX Runtime's shared library.
    OnnxRuntime,
    /// Python packages from the package index, in an environment of their own.
    PythonPackages,
    /// Chromium and Node.
    Chromium,
    /// The viewer that pages embed.
    Viewer,
    /// The reference data sets; a user's clone has none of them.
    Data,
    /// Files of other programs, beside the reference data sets.
    Cases,
    /// A bucket, which `DGTR_S3_TEST` names.
    Bucket,
    /// The host name localhost.
    Localhost,
}

/// All of them, by their names in `DGTR_SKIP`.
const NAMES: [(&str, Need); 10] = [
    ("vulkan", Need::Vulkan),
    ("validation-layer", Need::ValidationLayer),
    ("onnxruntime", Need::OnnxRuntime),
    ("python-packages", Need::PythonPackages),
    ("chromium", Need::Chromium),
    ("viewer", Need::Viewer),
    ("data", Need::Data),
    ("cases", Need::Cases),
    ("bucket", Need::Bucket),
    ("localhost", Need::Localhost),
];

impl Need {
    fn name(self) -> &'static str {
        NAMES.iter().find(|(_, need)| *need == self).map_or("", |(name, _)| name)
    }
}

/// Whether `list` names `need`.
///
/// # Errors
/// A name in it that is none.
fn is_named(list: &str, need: Need) -> Result<bool, String> {
    let names = || list.split(',').map(str::trim).filter(|name| !name.is_empty());
    let known = || NAMES.iter().map(|(name, _)| *name);
    match names().find(|name| !known().any(|k| k == *name)) {
        Some(unknown) => Err(format!("DGTR_SKIP={unknown}: knows {}", known().collect::<Vec<_>>().join(", "))),
        None => Ok(names().any(|name| name == need.name())),
    }
}

/// The test that calls this needs what is missing: it fails, unless `DGTR_SKIP` names that. `what` says what was looked for.
///
/// # Panics
/// `DGTR_SKIP` does not name it, or names what is unknown.
#[track_caller]
#[expect(clippy::panic, reason = "tests fail by panicking")]
pub fn missing(need: Need, what: impl Display) {
    match is_named(&std::env::var("DGTR_SKIP").unwrap_or_default(), need) {
        Ok(true) => println!("skipped: {what}"),
        Ok(false) => panic!("{what}; DGTR_SKIP={} skips the tests that need it", need.name()),
        Err(e) => panic!("{e}"),
    }
}

/// A file or folder of the reference data (beside the checkout, or where `DGTR_DATA` says).
///
/// # Panics
/// It is not there, and `DGTR_SKIP` does not name `data` (`cases` for what is below field/).
#[track_caller]
pub fn shared(path: &str) -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    let path = std::env::var_os("DGTR_DATA").map_or_else(beside, PathBuf::from).join(path);
    if path.exists() {
        return Some(path);
    }
    let need = if path.components().any(|part| part.as_os_str() == "field") { Need::Cases } else { Need::Data };
    missing(need, format!("{} is not there (DGTR_DATA names the folder that holds data/ and field/)", path.display()));
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_named_is_skipped_and_a_name_that_is_none_is_told() {
        assert_eq!(is_named("", Need::Vulkan), Ok(false));
        assert_eq!(is_named("data, vulkan", Need::Vulkan), Ok(true));
        assert_eq!(is_named("data", Need::Vulkan), Ok(false));
        let error = is_named("vulkna", Need::Vulkan).expect_err("a typing error");
        assert!(error.contains("vulkna") && error.contains("validation-layer"), "{error}");
    }
}
