//! Where renderings of pictures are written: below one folder, under the pictures' own names.

use std::collections::HashSet;
use std::path::{Component, Path, PathBuf};

use crate::error::EngineError;

/// A file for each picture and each of `endings`, relative to the folder of results: the picture's path below what all of them
/// have in common, without its extension where that leaves no two alike.
///
/// # Errors
/// Two files would have one name.
pub fn places(names: &[&str], endings: &[&str]) -> Result<Vec<Vec<PathBuf>>, EngineError> {
    let paths: Vec<Vec<String>> = names.iter().map(|name| below(name)).collect();
    let folders = |path: &[String]| path.len().saturating_sub(1);
    let first = paths.first().cloned().unwrap_or_default();
    let common = (0..paths.iter().map(|p| folders(p)).min().unwrap_or(0))
        .take_while(|k| paths.iter().all(|path| path[*k] == first[*k]))
        .count();
    let bare = |path: &PathBuf| path.with_extension("").into_os_string();
    let paths: Vec<PathBuf> = paths.iter().map(|path| path[common..].iter().collect()).collect();
    let named = |stem: &dyn Fn(&PathBuf) -> std::ffi::OsString| -> Vec<Vec<PathBuf>> {
        let file = |path: &PathBuf, ending: &&str| {
            let mut name = stem(path);
            name.push(ending);
            PathBuf::from(name)
        };
        paths.iter().map(|path| endings.iter().map(|ending| file(path, ending)).collect()).collect()
    };
    for files in [named(&bare), named(&|path: &PathBuf| path.clone().into_os_string())] {
        let mut seen = HashSet::new();
        if files.iter().flatten().all(|file| seen.insert(file)) {
            return Ok(files);
        }
    }
    let twice = paths.iter().enumerate().find(|(i, path)| paths[..*i].contains(path));
    let which = twice.map_or_else(String::new, |(_, path)| format!(" ({})", path.display()));
    Err(EngineError::Request(format!("two pictures have one name{which}: their renderings would overwrite each other")))
}

/// Folders and file name without what leads out of the folder of results.
fn below(name: &str) -> Vec<String> {
    let name = name.replace('\\', "/");
    let parts = Path::new(&name).components().filter_map(|part| match part {
        Component::Normal(part) => Some(part.to_string_lossy().into_owned()),
        _ => None,
    });
    let parts: Vec<String> = parts.collect();
    if parts.is_empty() { vec!["picture".to_owned()] } else { parts }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(names: &[&str], endings: &[&str]) -> Vec<String> {
        places(names, endings).unwrap_or_default().iter().flatten().map(|p| p.to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn no_two_renderings_share_a_file() {
        assert_eq!(of(&["images/a.jpg", "images/b.jpg"], &[".png"]), ["a.png", "b.png"]);
        assert_eq!(of(&["train/r_0.png", "test/r_0.png"], &[".png"]), ["train/r_0.png", "test/r_0.png"]);
        assert_eq!(of(&["/card/1/a.jpg", "/card/2/a.jpg", "/card/c.jpg"], &[".png"]), ["1/a.png", "2/a.png", "c.png"]);
        assert_eq!(of(&["a.jpg", "a.png"], &[".png"]), ["a.jpg.png", "a.png.png"]);
        let both = [".png", "_depth.png"];
        assert_eq!(
            of(&["a.jpg", "a_depth.jpg"], &both),
            ["a.jpg.png", "a.jpg_depth.png", "a_depth.jpg.png", "a_depth.jpg_depth.png"]
        );
        assert_eq!(of(&["../../etc/a.png", "./b"], &[".png"]), ["etc/a.png", "b.png"], "nothing leads out");
        for name in ["/tmp/esc/..", "..", "", "/", "C:\\x\\..\\..\\a.jpg"] {
            let file = PathBuf::from(of(&[name], &[".png"]).concat());
            assert!(file.components().all(|part| matches!(part, Component::Normal(_))), "{name:?}: {file:?}");
            assert!(file.extension().is_some_and(|e| e == "png"), "{name:?}: {file:?}");
        }
        let error = places(&["x/a.jpg", "x/a.jpg"], &[".png"]).err().map(|e| e.to_string()).unwrap_or_default();
        assert!(error.contains("a.jpg") && !error.contains('\n'), "{error}");
    }
}
