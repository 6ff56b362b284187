//! What was found of a pair of models, kept in a folder: each pair is fitted once, however often the ground is started.
//!
//! A pair is known by the contents of both files and how their telemetry places one in the other's frame, so that a new version of
//! a model, and nothing else, asks for new fits. One small file per pair, through the durable-write module.

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

use disk::Disk;
use glam::{DQuat, DVec3};
use models::align::similarity::Similarity;
use serde::{Deserialize, Serialize};

use crate::frame::Motion;
use crate::member::Member;

/// Begins every file; another number when fits are made in another way.
const MAGIC: [u8; 8] = *b"dgtredg3";
/// What follows the name of a pair.
const SUFFIX: &str = "edge";
/// Longest file taken.
const MOST_BYTES: u64 = 4096;
const HASH: usize = 32;

/// How one model fits onto another, in the frame of the first one's file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fitted {
    /// x y z w, scale and shift that bring the second, where telemetry places it, onto the first.
    pub turn: [f64; 4],
    /// Above 0.
    pub scale: f64,
    /// Metres.
    pub shift: [f64; 3],
    /// Six places of the second that stand for all that agree: same middle, same spread.
    pub places: [[f64; 3]; 6],
    /// Points that agree, of those matched.
    pub points: [u32; 2],
    /// Root mean square distance of the agreeing points across the lines of sight, metres: before and after.
    pub rms_m: [f64; 2],
}

impl Fitted {
    /// As a motion.
    pub fn motion(&self) -> Motion {
        let translation = DVec3::from(self.shift);
        Motion::of(Similarity { scale: self.scale, rotation: DQuat::from_array(self.turn), translation })
    }

    fn is_finite(&self) -> bool {
        let numbers = [self.scale, self.rms_m[0], self.rms_m[1]];
        let all = self.turn.iter().chain(&self.shift).chain(self.places.as_flattened()).chain(&numbers);
        all.copied().all(f64::is_finite) && self.scale > 0.0 && DQuat::from_array(self.turn).length() > 0.5
    }
}

/// A pair's name.
pub type Key = [u8; 32];

/// The name of a pair of models; the first is the one whose content comes first.
pub fn key(first: &Member, second: &Member) -> Key {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&MAGIC).update(first.content()).update(second.content());
    let prior = *second.to_frame_of(first).similarity();
    for v in prior.rotation.to_array().into_iter().chain(prior.translation.to_array()) {
        hasher.update(&v.to_le_bytes());
    }
    *hasher.finalize().as_bytes()
}

/// Pairs that were looked at.
#[derive(Debug)]
pub struct Edges {
    disk: Disk,
    folder: PathBuf,
    /// None: they have too little in common.
    known: HashMap<Key, Option<Fitted>>,
    /// Files that could not be used, by name and reason.
    pub damaged: Vec<String>,
}

impl Edges {
    /// What lies in `folder`, which is made when there is something to put into it.
    pub fn open(disk: &Disk, folder: &Path) -> Self {
        disk.sweep_abandoned(folder);
        Self { disk: disk.clone(), folder: folder.into(), known: HashMap::new(), damaged: Vec::new() }
    }

    fn path(&self, key: &Key) -> PathBuf {
        self.folder.join(blake3::Hash::from_bytes(*key).to_hex().as_str()).with_extension(SUFFIX)
    }

    /// What is known of a pair: None when nothing is.
    pub fn get(&mut self, key: &Key) -> Option<Option<Fitted>> {
        if let Some(known) = self.known.get(key) {
            return Some(*known);
        }
        let path = self.path(key);
        let opened = match disk::regular::open(&path) {
            Err(e) if e.kind() == ErrorKind::NotFound => return None,
            opened => opened.map_err(|_| "cannot be opened"),
        };
        match opened.and_then(|file| read(file, key)) {
            Ok(found) => {
                self.known.insert(*key, found);
                Some(found)
            }
            Err(why) => {
                self.damaged.push(format!("{}: {why}; the pair is fitted again", path.display()));
                None
            }
        }
    }

    /// Keeps what was found of a pair.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn put(&mut self, key: &Key, found: Option<Fitted>) -> Result<(), String> {
        let path = self.path(key);
        let mut bytes = MAGIC.to_vec();
        bytes.extend(key);
        bytes.extend(postcard::to_allocvec(&found).map_err(|e| e.to_string())?);
        bytes.extend(blake3::hash(&bytes).as_bytes());
        self.disk
            .replace(&path, |out| out.write_all(&bytes))
            .map_err(|e| format!("{}: {}", path.display(), disk::told(&e.source)))?;
        self.known.insert(*key, found);
        Ok(())
    }

    /// Forgets every pair that is not in use: models that were replaced.
    pub fn keep_only(&mut self, used: &HashSet<Key>) {
        self.known.retain(|key, _| used.contains(key));
        let names: HashSet<PathBuf> = used.iter().map(|key| self.path(key)).collect();
        let Ok(entries) = std::fs::read_dir(&self.folder) else { return };
        let is_stale = |path: &PathBuf| path.extension().is_some_and(|e| e == SUFFIX) && !names.contains(path);
        for path in entries.flatten().map(|e| e.path()).filter(is_stale) {
            // Left over it costs room, nothing else.
            let _ = self.disk.remove(&path);
        }
    }
}

fn read(file: File, key: &Key) -> Result<Option<Fitted>, &'static str> {
    let mut bytes = Vec::new();
    file.take(MOST_BYTES + 1).read_to_end(&mut bytes).map_err(|_| "it cannot be read")?;
    if bytes.len() as u64 > MOST_BYTES || bytes.len() < MAGIC.len() + key.len() + HASH {
        return Err("it is not as long as an edge is");
    }
    let (content, hash) = bytes.split_at(bytes.len() - HASH);
    if blake3::hash(content).as_bytes() != hash {
        return Err("its checksum is wrong");
    }
    let body = content.strip_prefix(&MAGIC).and_then(|c| c.strip_prefix(key)).ok_or("it belongs to another pair")?;
    let found: Option<Fitted> = postcard::from_bytes(body).map_err(|_| "it cannot be decoded")?;
    match found.is_none_or(|f| f.is_finite()) {
        true => Ok(found),
        false => Err("it holds numbers that are not finite"),
    }
}
