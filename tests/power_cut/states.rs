//! Everything that may be on the medium after a power cut.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

use super::{Done, FileId};

/// So many pending names are combined in every way; of more, each alone, all but each, and every run from the first.
const MAX_COMBINED: usize = 4;

/// How content that was not synced is found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Unsynced {
    Whole,
    Lost,
    Torn,
    Zeros,
}

/// One possible content of a folder: a name is a file's bytes or a folder.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct State(BTreeMap<PathBuf, Option<Vec<u8>>>);

impl State {
    /// Lays the state out in `root`, which stands for the folder `recorded` that was recorded in.
    ///
    /// # Errors
    /// The system's.
    pub fn lay_out(&self, recorded: &Path, root: &Path) -> std::io::Result<()> {
        for (path, content) in &self.0 {
            let Ok(below) = path.strip_prefix(recorded) else { continue };
            // A name below a folder whose own name was lost is lost with it.
            match content {
                None if root.join(below).parent().is_some_and(Path::is_dir) => {
                    std::fs::create_dir_all(root.join(below))?
                }
                Some(bytes) if root.join(below).parent().is_some_and(Path::is_dir) => {
                    std::fs::write(root.join(below), bytes)?;
                }
                _ => {}
            }
        }
        Ok(())
    }
}

#[derive(Default)]
struct File {
    bytes: Vec<u8>,
    synced: usize,
}

type Change = Vec<(PathBuf, Option<Option<FileId>>)>;

/// Calls `each` with every state that the medium may be in after the first n operations, for every n, with what was
/// promised until then. No state is shown twice with the same promises. Returns how many there were.
pub fn each<P: Clone>(done: &[Done<P>], mut each: impl FnMut(State, &[P])) -> usize {
    let mut files: HashMap<FileId, File> = HashMap::new();
    let mut durable: BTreeMap<PathBuf, Option<FileId>> = BTreeMap::new();
    let mut pending: Vec<Change> = Vec::new();
    let mut promised: Vec<P> = Vec::new();
    let (mut seen, mut count) = (HashSet::new(), 0);
    for step in done {
        match step {
            Done::Names(change) => pending.push(change.clone()),
            Done::Wrote(file, bytes) => files.entry(*file).or_default().bytes.extend_from_slice(bytes),
            Done::TookOff(file, bytes) => {
                let file = files.entry(*file).or_default();
                file.bytes.truncate(file.bytes.len() - bytes);
                file.synced = file.synced.min(file.bytes.len());
            }
            Done::Synced(file) => {
                let file = files.entry(*file).or_default();
                file.synced = file.bytes.len();
            }
            Done::SyncedFolder(folder) => {
                let (now, later): (Vec<_>, Vec<_>) =
                    pending.drain(..).partition(|c| c.iter().any(|(path, _)| path.parent() == Some(folder)));
                now.iter().for_each(|change| apply(&mut durable, change));
                pending = later;
            }
            Done::Promised(promise) => promised.push(promise.clone()),
        }
        for chosen in choices(pending.len()) {
            let mut names = durable.clone();
            pending.iter().zip(&chosen).filter(|(_, is)| **is).for_each(|(change, _)| apply(&mut names, change));
            for found in [Unsynced::Whole, Unsynced::Lost, Unsynced::Torn, Unsynced::Zeros] {
                let content = |id: &FileId| files.get(id).map(|f| as_found(f, found)).unwrap_or_default();
                let state = State(names.iter().map(|(p, file)| (p.clone(), file.as_ref().map(content))).collect());
                let mut hasher = DefaultHasher::new();
                (&state, promised.len()).hash(&mut hasher);
                if seen.insert(hasher.finish()) {
                    count += 1;
                    each(state, &promised);
                }
            }
        }
    }
    count
}

fn apply(names: &mut BTreeMap<PathBuf, Option<FileId>>, change: &Change) {
    for (path, to) in change {
        match to {
            Some(to) => names.insert(path.clone(), *to),
            None => names.remove(path),
        };
    }
}

fn as_found(file: &File, found: Unsynced) -> Vec<u8> {
    let (synced, all) = (file.synced, file.bytes.len());
    let until = match found {
        Unsynced::Whole => all,
        Unsynced::Lost | Unsynced::Zeros => synced,
        Unsynced::Torn => synced + (all - synced) / 2,
    };
    let mut bytes = file.bytes[..until].to_vec();
    if found == Unsynced::Zeros {
        bytes.resize(all, 0);
    }
    bytes
}

/// Which of `n` pending changes are on the medium.
fn choices(n: usize) -> Vec<Vec<bool>> {
    if n <= MAX_COMBINED {
        return (0..1u32 << n).map(|bits| (0..n).map(|i| bits >> i & 1 == 1).collect()).collect();
    }
    let first = (0..=n).map(|k| (0..n).map(|i| i < k).collect());
    let alone = (0..n).flat_map(|k| [(0..n).map(|i| i == k).collect(), (0..n).map(|i| i != k).collect()]);
    first.chain(alone).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_renamed_before_it_is_synced_may_be_found_empty_torn_or_full_of_zeros() {
        let (aside, name) = (PathBuf::from("/d/.aside"), PathBuf::from("/d/name"));
        let done: Vec<Done<()>> = vec![
            Done::Names(vec![(aside.clone(), Some(Some(0)))]),
            Done::Wrote(0, b"content!".to_vec()),
            Done::Names(vec![(aside, None), (name.clone(), Some(Some(0)))]),
            Done::SyncedFolder("/d".into()),
        ];
        let mut found = Vec::new();
        each(&done, |state, _| found.extend(state.0.get(&name).cloned().flatten()));
        for content in [&b"content!"[..], b"", b"cont", &[0; 8]] {
            assert!(found.contains(&content.to_vec()), "{content:?} is not in {found:?}");
        }
    }

    #[test]
    fn names_that_are_pending_may_be_there_in_any_combination() {
        let (a, b) = (PathBuf::from("/d/a"), PathBuf::from("/d/b"));
        let name = |p: &PathBuf, id| Done::Names(vec![(p.clone(), Some(Some(id)))]);
        let done: Vec<Done<()>> = vec![name(&a, 0), name(&b, 1)];
        let mut found = HashSet::new();
        each(&done, |state, _| _ = found.insert((state.0.contains_key(&a), state.0.contains_key(&b))));
        assert_eq!(found.len(), 4);
    }
}
