//! The viewer's files, as the setup script unpacked them: looked for, bounded, and compared with the hashes that were pinned.

use std::path::{Path, PathBuf};

use config::keys::to_hex;
use models::formats::read_bounded;
use sha2::{Digest, Sha256};

use super::ViewerError;

/// Package and version on the first line, then a hash and a file a line; `setup.sh` reads it, too.
const PIN: &str = include_str!("../../../viewer.pin");
/// Most bytes of a file of the viewer; its script has 3.3 MB.
const MAX_FILE: u64 = 16 << 20;

/// What goes into a page.
pub(super) struct Package {
    pub script: String,
    pub style: String,
    pub licence: String,
}

impl Package {
    /// The first installed one.
    ///
    /// # Errors
    /// [`ViewerError::Missing`] where there is none, [`ViewerError::Other`] for one that is not the pinned version.
    pub(super) fn find() -> Result<Self, ViewerError> {
        let folders = folders();
        let found =
            folders.iter().find(|f| f.join("public/index.js").is_file()).ok_or_else(|| ViewerError::Missing {
                searched: folders.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join(", "),
                name: name(),
            })?;
        Ok(Self {
            script: checked(found, "public/index.js")?,
            style: checked(found, "public/index.css")?,
            licence: checked(found, "LICENSE")?,
        })
    }
}

fn name() -> &'static str {
    PIN.lines().next().unwrap_or_default()
}

/// Where it may be, in order.
fn folders() -> Vec<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    if let Some(folder) = variable("DGTR_VIEWER") {
        // The user has said which; another one found by luck would only confuse.
        return vec![folder];
    }
    let own = variable("XDG_DATA_HOME").or_else(|| variable("HOME").map(|home| home.join(".local/share")));
    let mut folders: Vec<PathBuf> = own.into_iter().map(|share| share.join("dgtr/viewer")).collect();
    // Beside bin/, as packages lay files out.
    let beside = std::env::current_exe().ok().and_then(|p| p.parent().map(|bin| bin.join("../share/dgtr/viewer")));
    folders.extend(beside);
    folders
}

fn checked(folder: &Path, file: &str) -> Result<String, ViewerError> {
    let path = folder.join(file);
    let bytes = read_bounded(&path, MAX_FILE)?;
    let pinned = PIN.lines().find_map(|line| line.strip_prefix("sha256 ")?.strip_suffix(file)?.strip_suffix(' '));
    let hash = to_hex(&Sha256::digest(&bytes).into());
    let text = String::from_utf8(bytes).ok().filter(|_| pinned == Some(hash.as_str()));
    text.ok_or(ViewerError::Other { path, name: name() })
}
