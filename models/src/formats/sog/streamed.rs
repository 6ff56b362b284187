//! Streamed SOG: a scene in leaves of ground, each at several levels of detail, in a folder of SOG files that a viewer loads as it comes near.
//!
//! `lod-meta.json` names the leaves, their bounds, and for each level a file, the first of its rows there and their number; leaves share files. Source:
//! PlayCanvas' "Streamed SOG", and `splat-transform`'s writer where it is silent. The file is written last: without it there is no scene.

use std::path::{Path, PathBuf};

use disk::Disk;
use glam::{DMat3, DQuat, DVec3};
use serde::Serialize;

use super::{Asset, GENERATOR, morton_order, pack};
use crate::cloud::GaussianCloud;
use crate::formats::{FormatError, write_atomic};

/// Gaussians of a file, about: a leaf is never cut, and a request should be worth its round trip.
const FILE: usize = 1 << 17;
const VERSION: u32 = 1;
/// Leaves that share a node of the tree.
const CHILDREN: usize = 8;
/// Name of the index.
pub const INDEX: &str = "lod-meta.json";

#[derive(Serialize)]
struct Meta<'a> {
    version: u32,
    asset: Asset,
    count: u64,
    counts: &'a [u64],
    #[serde(rename = "lodLevels")]
    levels: usize,
    filenames: &'a [String],
    tree: Node,
}

#[derive(Clone, Copy, Serialize)]
struct Bound {
    min: [f32; 3],
    max: [f32; 3],
}

#[derive(Serialize)]
#[serde(untagged)]
enum Node {
    Leaf { bound: Bound, lods: Lods },
    Inner { bound: Bound, children: Vec<Node> },
}

/// A level's rows by the level's number.
type Lods = std::collections::BTreeMap<String, Rows>;

#[derive(Clone, Copy, Serialize)]
struct Rows {
    file: usize,
    offset: usize,
    count: usize,
}

/// The files of one level.
struct Level {
    cloud: GaussianCloud,
    /// Rows in the order in which they are written.
    order: Vec<u32>,
    /// Files begun.
    files: usize,
    /// Name of the open one in the index.
    name: usize,
}

/// A scene while it is written.
pub struct Writer {
    folder: PathBuf,
    shift: [f32; 3],
    levels: Vec<Level>,
    counts: Vec<u64>,
    filenames: Vec<String>,
    leaves: Vec<Node>,
}

impl Writer {
    /// Begins a scene of so many levels in `folder`, with means less `shift` in the files.
    ///
    /// # Errors
    /// The operating system's.
    pub fn create(folder: &Path, levels: usize, sh_degree: u8, shift: [f32; 3]) -> Result<Self, FormatError> {
        let failed = |e| FormatError::io(folder, "creating", e);
        let disk = Disk::default();
        disk.make_folders(folder).map_err(failed)?;
        disk.remove(&folder.join(INDEX)).map_err(failed)?;
        let level =
            || Level { cloud: GaussianCloud::with_capacity(sh_degree, 0), order: Vec::new(), files: 0, name: 0 };
        Ok(Self {
            folder: folder.to_owned(),
            shift,
            levels: (0..levels).map(|_| level()).collect(),
            counts: vec![0; levels],
            filenames: Vec::new(),
            leaves: Vec::new(),
        })
    }

    /// Adds a leaf: its Gaussians at every level, the finest first.
    ///
    /// # Errors
    /// As [`super::encode`], and the operating system's.
    pub fn leaf(&mut self, levels: &[GaussianCloud]) -> Result<(), FormatError> {
        let mut bound = Bound { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };
        let mut lods = Lods::new();
        for (number, cloud) in levels.iter().enumerate().filter(|(_, cloud)| !cloud.is_empty()) {
            (0..cloud.len()).for_each(|i| bound.add(cloud, i, self.shift));
            let level = &mut self.levels[number];
            if level.cloud.is_empty() {
                level.name = self.filenames.len();
                self.filenames.push(format!("{number}_{}/meta.json", level.files));
                level.files += 1;
            }
            let offset = level.cloud.len();
            level.cloud.extend(cloud);
            level.order.extend(morton_order(&level.cloud, offset..offset + cloud.len()));
            lods.insert(number.to_string(), Rows { file: level.name, offset, count: cloud.len() });
            self.counts[number] += cloud.len() as u64;
            if level.cloud.len() >= FILE {
                self.flush(number)?;
            }
        }
        if !lods.is_empty() {
            self.leaves.push(Node::Leaf { bound, lods });
        }
        Ok(())
    }

    /// Writes the open file of a level.
    fn flush(&mut self, number: usize) -> Result<(), FormatError> {
        let level = &mut self.levels[number];
        let folder = self.folder.join(format!("{number}_{}", level.files - 1));
        Disk::default().make_folders(&folder).map_err(|e| FormatError::io(&folder, "creating", e))?;
        for (name, bytes) in pack(&folder, &level.cloud, &level.order, self.shift)? {
            write_atomic(&folder.join(name), |out| out.write_all(&bytes))?;
        }
        level.cloud.retain(|_| false);
        level.order.clear();
        Ok(())
    }

    /// Writes what is left, then the index; Gaussians of each level.
    ///
    /// # Errors
    /// [`FormatError::Invalid`] for a scene without Gaussians, else the operating system's.
    pub fn finish(mut self) -> Result<Vec<u64>, FormatError> {
        for number in 0..self.levels.len() {
            if !self.levels[number].cloud.is_empty() {
                self.flush(number)?;
            }
        }
        let Some(tree) = tree(self.leaves) else {
            return Err(FormatError::invalid(&self.folder, "no Gaussians to write; train the model first"));
        };
        let meta = Meta {
            version: VERSION,
            asset: Asset { generator: GENERATOR },
            count: self.counts.iter().sum(),
            counts: &self.counts,
            levels: self.levels.len(),
            filenames: &self.filenames,
            tree,
        };
        let path = self.folder.join(INDEX);
        let json = serde_json::to_vec(&meta).map_err(|e| FormatError::io(&path, "writing", e.into()))?;
        write_atomic(&path, |out| out.write_all(&json))?;
        Ok(self.counts)
    }
}

/// Neighbours under one node, and those under one again.
fn tree(mut nodes: Vec<Node>) -> Option<Node> {
    while nodes.len() > 1 {
        let mut left = nodes.into_iter().peekable();
        let mut above = Vec::new();
        while left.peek().is_some() {
            let children: Vec<Node> = left.by_ref().take(CHILDREN).collect();
            let bound = children.iter().map(Node::bound).reduce(Bound::with);
            above.extend(bound.map(|bound| Node::Inner { bound, children }));
        }
        nodes = above;
    }
    nodes.pop()
}

impl Node {
    fn bound(&self) -> Bound {
        match self {
            Self::Leaf { bound, .. } | Self::Inner { bound, .. } => *bound,
        }
    }
}

impl Bound {
    fn with(self, other: Self) -> Self {
        Self {
            min: [0, 1, 2].map(|k| self.min[k].min(other.min[k])),
            max: [0, 1, 2].map(|k| self.max[k].max(other.max[k])),
        }
    }

    /// Takes in a Gaussian as far as one standard deviation, as splat-transform does.
    fn add(&mut self, cloud: &GaussianCloud, i: usize, shift: [f32; 3]) {
        let [w, x, y, z] = cloud.rotations[i].map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let sigma = DVec3::from_array(cloud.log_scales[i].map(|s| f64::from(s).exp()));
        let reach = [0, 1, 2].map(|k| (axes.row(k).abs() * sigma).element_sum() as f32);
        let mean = [0, 1, 2].map(|k| cloud.means[i][k] - shift[k]);
        let own = Self { min: [0, 1, 2].map(|k| mean[k] - reach[k]), max: [0, 1, 2].map(|k| mean[k] + reach[k]) };
        *self = self.with(own);
    }
}
