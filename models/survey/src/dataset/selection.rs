//! Which frames are for what: `split.json`, what the description holds out, or every eighth held out.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;

use super::{Dataset, DatasetError, picture_names};
use models::formats::{FormatError, split};

/// Without a `split.json` every eighth picture is held out, as 3DGS and its successors do.
const TEST_EVERY: usize = 8;

/// An area flown by one aircraft.
#[derive(Clone, Debug)]
pub struct FlownRegion {
    /// Its name (`--region`).
    pub name: String,
    /// Corners counter-clockwise, ENU metres.
    pub polygon: Vec<[f64; 2]>,
    /// Frame numbers by list name.
    pub lists: BTreeMap<String, Vec<usize>>,
}

/// Which frames are for what, as indices into [`Dataset::frames`].
#[derive(Clone, Debug, Default)]
pub struct Split {
    /// `train`, `test`, …
    pub lists: BTreeMap<String, Vec<usize>>,
    /// May be empty.
    pub regions: Vec<FlownRegion>,
}

impl Dataset {
    /// `held_out`: what the description says of it.
    pub(super) fn with_split(mut self, held_out: Option<Vec<usize>>) -> Result<Self, DatasetError> {
        let file = self.root.join("split.json");
        self.split = match held_out {
            _ if file.is_file() => self.resolve(&file)?,
            Some(test) => self.without(test),
            None => self.without(self.every_eighth()),
        };
        Ok(self)
    }

    /// The frames of a split, restricted to a region's when one is named; `all` is always a split.
    ///
    /// # Errors
    /// A name that the data set does not have.
    pub fn select(&self, split: &str, region: Option<&str>) -> Result<Vec<usize>, DatasetError> {
        let unknown = |kind, name: &str, known: Vec<&str>| DatasetError::Unknown {
            root: self.root.clone(),
            kind,
            name: name.to_owned(),
            known: if known.is_empty() { "none".to_owned() } else { known.join(", ") },
        };
        let all: Vec<usize> = (0..self.frames.len()).collect();
        let whole = match self.split.lists.get(split) {
            Some(list) => list,
            None if split == "all" => &all,
            None => {
                return Err(unknown(
                    "split",
                    split,
                    self.split.lists.keys().map(String::as_str).chain(["all"]).collect(),
                ));
            }
        };
        let Some(name) = region else { return Ok(whole.clone()) };
        let regions = &self.split.regions;
        let Some(region) = regions.iter().find(|r| r.name == name) else {
            return Err(unknown("region", name, regions.iter().map(|r| r.name.as_str()).collect()));
        };
        Ok(match region.lists.get(split) {
            Some(list) => list.clone(),
            None => whole.iter().copied().filter(|i| region.lists.values().any(|l| l.contains(i))).collect(),
        })
    }

    /// The region of this name.
    pub fn region(&self, name: &str) -> Option<&FlownRegion> {
        self.split.regions.iter().find(|r| r.name == name)
    }

    fn every_eighth(&self) -> Vec<usize> {
        let mut by_name: Vec<usize> = (0..self.frames.len()).collect();
        by_name.sort_by(|&a, &b| self.frames[a].name.cmp(&self.frames[b].name));
        by_name.iter().copied().step_by(TEST_EVERY).collect()
    }

    fn without(&self, mut test: Vec<usize>) -> Split {
        test.sort_unstable();
        let train = (0..self.frames.len()).filter(|i| test.binary_search(i).is_err()).collect();
        Split { lists: BTreeMap::from([("test".to_owned(), test), ("train".to_owned(), train)]), regions: Vec::new() }
    }

    fn resolve(&self, path: &Path) -> Result<Split, DatasetError> {
        let file = split::read(path)?;
        let known = picture_names(self);
        let lists = |lists: BTreeMap<String, Vec<String>>| -> Result<BTreeMap<String, Vec<usize>>, DatasetError> {
            lists
                .into_iter()
                .map(|(list, names)| {
                    let numbers = names.iter().map(|n| {
                        known.find(n).ok_or_else(|| {
                            FormatError::invalid(
                                path,
                                format!("list {list:?} names {n:?}, which is not a picture of this data set"),
                            )
                            .into()
                        })
                    });
                    let numbers = numbers.collect::<Result<Vec<_>, DatasetError>>()?;
                    Ok((list, numbers))
                })
                .collect()
        };
        let mut regions = Vec::with_capacity(file.regions.len());
        for r in file.regions {
            let mut lists = lists(r.lists)?;
            // A region calls its `train_dense` list `images`.
            if let Some(images) = lists.get("images").cloned() {
                lists.entry("train_dense".to_owned()).or_insert(images);
            }
            let own = |[x, y]: [f64; 2]| {
                let p = DVec3::new(x, y, 0.0);
                self.local.map_or(p, |local| local.into_own(p)).truncate().to_array()
            };
            let polygon = vec![[r.min[0], r.min[1]], [r.max[0], r.min[1]], [r.max[0], r.max[1]], [r.min[0], r.max[1]]];
            regions.push(FlownRegion { name: r.name, polygon: polygon.into_iter().map(own).collect(), lists });
        }
        Ok(Split { lists: lists(file.lists)?, regions })
    }
}
