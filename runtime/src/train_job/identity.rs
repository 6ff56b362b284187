//! What a training in a folder of results was made from, so that another one is not taken for its continuation; and the lock that keeps two
//! from writing there at once.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use config::training::TrainSettings;
use disk::{Disk, FolderLock};
use models::formats::{FormatError, read_bounded};
use survey::dataset::Dataset;

use super::TrainJob;
use crate::error::JobError;

/// The record of it in the folder of results.
const FILE: &str = "job.json";
/// A card's poses.
const SETTLED: &str = super::card::FILE;
/// A few hashes and names.
const LIMIT: u64 = 64 << 10;
/// Masks are small pictures.
const LARGEST_MASK: u64 = 256 << 20;

/// The folder of results is this process's as long as it lives.
pub(super) struct Held {
    #[expect(dead_code, reason = "the folder is this process's as long as the lock lives")]
    lock: FolderLock,
    /// The folder, if it was made for this job: one in which nothing came to lie goes again.
    made: Option<PathBuf>,
}

impl Drop for Held {
    fn drop(&mut self) {
        if let Some(made) = &self.made {
            // Refused by the system where anything lies in it.
            let _ = std::fs::remove_dir(made);
        }
    }
}

/// Takes `out` for this process.
///
/// # Errors
/// Another process trains into it, or the folder cannot be written to.
pub(super) fn hold(out: &Path) -> Result<Held, JobError> {
    let made = (!out.exists()).then(|| out.to_owned());
    std::fs::create_dir_all(out).map_err(JobError::io(out))?;
    let Some(lock) = FolderLock::take(out).map_err(JobError::io(out))? else {
        let what = format!("{}: another dgtr train writes here; let it end, or give another --out", out.display());
        return Err(JobError::Request(what));
    };
    if !lock.held() {
        tracing::warn!("{}: cannot be locked; nothing keeps a second dgtr out", out.display());
    }
    Ok(Held { lock, made })
}

/// Hashes of what a model is made from, by what they are of.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) struct Identity(BTreeMap<String, String>);

impl Identity {
    /// Of `job` over the pictures of `set` as it was opened.
    ///
    /// # Errors
    /// A mask cannot be read.
    pub(super) fn of(job: &TrainJob, set: &Dataset) -> Result<Self, JobError> {
        let [mut names, mut sizes, mut poses, mut lenses, mut masks] = [(); 5].map(|()| blake3::Hasher::new());
        for frame in &set.frames {
            let lens = &frame.view.intrinsics;
            put(&mut names, &frame.name);
            put(&mut sizes, &(&frame.name, lens.width, lens.height));
            put(&mut poses, &(&frame.name, frame.view.pose, frame.prior));
            put(&mut lenses, &(&frame.name, lens, frame.distortion, frame.orientation));
            if let Some(mask) = &frame.mask {
                put(&mut masks, &frame.name);
                masks.update(&read_bounded(mask, LARGEST_MASK)?);
            }
        }
        put(&mut poses, &set.origin);
        if let Some(card) = &set.card {
            put(&mut poses, &(&card.control, card.floats));
        }
        // How long it goes on and what is said of it at the end change nothing that was learnt before.
        let (memory, rule) = (&job.memory, job.pictures.by_rule.then_some(&job.recipe.keyframes));
        let training =
            TrainSettings { steps: 1, seconds: None, energy_wh: None, watts: None, ..job.recipe.training.clone() };
        let mut settings = blake3::Hasher::new();
        put(&mut settings, &(&training, &job.recipe.init, &job.recipe.network, job.pictures.scale, job.for_delivery));
        put(&mut settings, &(memory.device_mib, memory.max_gaussians, memory.scene_gaussians, job.init, &job.from));
        put(&mut poses, &(job.poses.source, job.poses.refine, &job.recipe.refine));
        put(&mut names, &(&job.pictures.split, &job.pictures.region, rule));
        let of = [
            ("pictures", names),
            ("picture sizes", sizes),
            ("poses", poses),
            ("lenses", lenses),
            ("masks", masks),
            ("settings", settings),
        ];
        Ok(Self(of.into_iter().map(|(what, hash)| (what.to_owned(), hash.finalize().to_hex().to_string())).collect()))
    }

    /// Whether it has yet to be written into `out`: what lies there, if anything, was made from the same. With `fresh`, whatever
    /// lies there.
    ///
    /// # Errors
    /// Another training lies there: what is different is said.
    pub(super) fn is_new_in(&self, out: &Path, model: &Path, fresh: bool) -> Result<bool, JobError> {
        let file = out.join(FILE);
        // Where neither poses nor a model were written yet, nothing can be mistaken.
        let anything = model.is_file() || out.join(SETTLED).is_file();
        if !fresh
            && anything
            && let Some(before) = Self::read(&file)?
        {
            let differs = |(what, hash): &(&String, &String)| before.0.get(*what) != Some(*hash);
            let other: Vec<&str> = self.0.iter().filter(differs).map(|(what, _)| what.as_str()).collect();
            if other.is_empty() {
                return Ok(false);
            }
            return Err(JobError::Request(format!(
                "{}: holds a training with other {}; give another --out, or --fresh to begin anew",
                out.display(),
                other.join(", ")
            )));
        }
        if !fresh && model.is_file() {
            tracing::warn!(
                "{}: nothing beside it says what it was trained from; it is continued if its pictures have these names",
                model.display()
            );
        }
        Ok(true)
    }

    /// Writes it into `out`.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub(super) fn write(&self, out: &Path) -> Result<(), JobError> {
        let file = out.join(FILE);
        Disk::default()
            .replace(&file, |w| serde_json::to_writer_pretty(w, self).map_err(std::io::Error::other))
            .map_err(|e| FormatError::disk(&file, e))?;
        Ok(())
    }

    fn read(file: &Path) -> Result<Option<Self>, JobError> {
        if !file.is_file() {
            return Ok(None);
        }
        let bytes = read_bounded(file, LIMIT)?;
        let read = serde_json::from_slice(&bytes);
        Ok(Some(read.map_err(|e| FormatError::invalid(file, format!("{e}; --fresh begins anew")))?))
    }
}

/// Every value as it prints: numbers print so that no two of them look alike.
fn put(hash: &mut blake3::Hasher, value: &impl std::fmt::Debug) {
    let text = format!("{value:?}");
    hash.update(&(text.len() as u64).to_le_bytes());
    hash.update(text.as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity(poses: &str) -> Identity {
        Identity([("pictures", "a"), ("poses", poses)].map(|(k, v)| (k.to_owned(), v.to_owned())).into())
    }

    #[test]
    fn a_folder_of_another_training_is_refused_in_one_line_and_begun_anew_when_asked() {
        let dir = tempfile::tempdir().expect("a folder");
        let model = dir.path().join("model.dgtr");
        let claim = |poses, fresh| {
            let own = identity(poses);
            let is_new = own.is_new_in(dir.path(), &model, fresh).map_err(|e| e.to_string())?;
            if is_new { own.write(dir.path()).map_err(|e| e.to_string()) } else { Ok(()) }
        };
        assert_eq!((claim("a", false), claim("b", false)), (Ok(()), Ok(())), "nothing was trained yet");
        std::fs::write(&model, b"").expect("written");
        assert_eq!(claim("b", false), Ok(()));
        let error = claim("c", false).expect_err("other poses");
        assert!(error.contains("other poses;") && error.contains("--fresh") && !error.contains('\n'), "{error}");
        assert_eq!(claim("b", false), Ok(()), "nothing was changed by it");
        assert_eq!((claim("c", true), claim("c", false)), (Ok(()), Ok(())));
        std::fs::write(dir.path().join(FILE), "{").expect("written");
        assert!(claim("c", false).is_err_and(|e| e.contains("job.json")));
    }

    #[test]
    fn a_folder_is_held_by_one_training_at_a_time() {
        let dir = tempfile::tempdir().expect("a folder");
        let held = hold(dir.path()).expect("free");
        let error = hold(dir.path()).map(|_| ()).expect_err("held").to_string();
        assert!(error.contains("another dgtr train") && !error.contains('\n'), "{error}");
        drop(held);
        assert!(hold(dir.path()).is_ok() && dir.path().is_dir());
        // One that was made for a training that wrote nothing goes again.
        let new = dir.path().join("new");
        drop(hold(&new).expect("made"));
        assert!(!new.exists());
    }
}
