//! `split.json`: which pictures to train on and which to hold out, and the regions flown by one aircraft each.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::{FormatError, read_bounded, without_mark};

const LIMIT: u64 = 64 << 20;

/// Lists of picture names; every top-level key of the file that holds a list of strings is one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplitFile {
    /// By name: `train`, `train_dense`, `test`, …
    pub lists: BTreeMap<String, Vec<String>>,
    /// Areas flown separately; may be empty.
    pub regions: Vec<SplitRegion>,
}

/// One area with its own lists.
#[derive(Clone, Debug, PartialEq)]
pub struct SplitRegion {
    /// Its `id`, as text.
    pub name: String,
    /// Corner with the smallest east and north, metres.
    pub min: [f64; 2],
    /// Corner with the largest.
    pub max: [f64; 2],
    /// As in [`SplitFile::lists`]; `images` holds every picture that is not held out.
    pub lists: BTreeMap<String, Vec<String>>,
}

#[derive(Deserialize)]
struct RawRegion {
    id: Value,
    bbox_min_xy: [f64; 2],
    bbox_max_xy: [f64; 2],
    #[serde(flatten)]
    rest: BTreeMap<String, Value>,
}

#[derive(Deserialize)]
struct RawFile {
    #[serde(default)]
    regions: Vec<RawRegion>,
    #[serde(flatten)]
    rest: BTreeMap<String, Value>,
}

/// Reads `split.json`.
///
/// # Errors
/// The file cannot be read or is no split.
pub fn read(path: &Path) -> Result<SplitFile, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let raw: RawFile = serde_json::from_slice(without_mark(&bytes))
        .map_err(|e| FormatError::invalid(path, format!("not a split.json: {e}")))?;
    let mut regions = Vec::with_capacity(raw.regions.len());
    for r in raw.regions {
        let name = match r.id {
            Value::String(s) => s,
            other => other.to_string(),
        };
        let sane = r.bbox_min_xy.iter().zip(&r.bbox_max_xy).all(|(a, b)| a.is_finite() && b.is_finite() && a < b);
        if !sane {
            return Err(FormatError::invalid(path, format!("region {name}: bbox_min_xy must be below bbox_max_xy")));
        }
        regions.push(SplitRegion { name, min: r.bbox_min_xy, max: r.bbox_max_xy, lists: string_lists(r.rest) });
    }
    Ok(SplitFile { lists: string_lists(raw.rest), regions })
}

fn string_lists(values: BTreeMap<String, Value>) -> BTreeMap<String, Vec<String>> {
    let as_strings = |v: Value| match v {
        Value::Array(items) => items
            .into_iter()
            .map(|i| match i {
                Value::String(s) => Some(s),
                _ => None,
            })
            .collect::<Option<Vec<_>>>(),
        _ => None,
    };
    values.into_iter().filter_map(|(k, v)| as_strings(v).map(|l| (k, l))).collect()
}
