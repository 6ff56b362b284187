//! The data set that all methods are trained from: the pictures where they lie, with the regions and lists of the comparison and the
//! sparse points of the original, so that every training can be repeated by hand with `dgtr train`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use models::formats::transforms;
use serde_json::{Map, Value, json};
use survey::dataset::{Dataset, SparsePoint};

use super::territory::Territory;
use runtime::error::JobError;
use runtime::figures::{write_json, write_text};

/// Name of the list of training pictures.
pub const OWN: &str = "train";
/// Name of the list of those that a region is trained on when it has others' pictures that see it.
pub const SEEN: &str = "seen";

/// A written data set and what identifies it.
pub struct Written {
    /// Its folder.
    pub root: PathBuf,
    /// The data set, read back.
    pub set: Dataset,
    /// BLAKE3 of all that it says, as text.
    pub content: String,
}

/// Writes `set` to `root` with the lists of `territories` and, in the order of the territories, of the pictures that see them.
///
/// # Errors
/// `root` is the data set's own folder, it cannot be written to, or what was written cannot be read.
pub fn write(
    root: &Path,
    set: &Dataset,
    territories: &[Territory],
    seen: &[Vec<usize>],
    points: &[SparsePoint],
) -> Result<Written, JobError> {
    if root.canonicalize().is_ok_and(|to| set.root.canonicalize().is_ok_and(|from| to == from)) {
        let what = format!("{}: would be written over with its own regions; give another --out", root.display());
        return Err(JobError::Request(what));
    }
    // Names are those that reading gives: paths are whole here, which may have been relative to the original.
    let (description, split) = (root.join("transforms.json"), root.join("split.json"));
    std::fs::create_dir_all(root).map_err(JobError::io(root))?;
    match std::fs::remove_file(&split) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(JobError::io(&split)(e)),
        _ => {}
    }
    transforms::write(&description, &set.reconstruction())?;
    let named = Dataset::open(root)?;
    write_json(&split, &lists(&named, territories, seen))?;
    write_points(root, &named, points)?;
    // Of what is said, not of the files: another build may write the same JSON in another order.
    let mut hasher = blake3::Hasher::new();
    for frame in &named.frames {
        let what = (&frame.path, &frame.view, &frame.distortion, &frame.mask);
        hasher.update(format!("{} {what:?}", frame.name).as_bytes());
    }
    hasher.update(format!("{territories:?} {seen:?}").as_bytes());
    points.iter().for_each(|point| _ = hasher.update(format!("{point:?}").as_bytes()));
    let content = hasher.finalize().to_hex().to_string();
    Ok(Written { root: root.to_owned(), set: Dataset::open(root)?, content })
}

fn lists(set: &Dataset, territories: &[Territory], seen: &[Vec<usize>]) -> Value {
    let names =
        |frames: &[usize]| -> Value { frames.iter().map(|i| Value::from(set.frames[*i].name.as_str())).collect() };
    let all = |of: fn(&Territory) -> &Vec<usize>| {
        let mut frames: Vec<usize> = territories.iter().flat_map(|t| of(t).iter().copied()).collect();
        frames.sort_unstable();
        names(&frames)
    };
    let regions = territories.iter().zip(seen).map(|(t, seen)| {
        let mut region = Map::new();
        region.insert("id".into(), t.name.clone().into());
        region.insert("bbox_min_xy".into(), json!(t.low.to_array()));
        region.insert("bbox_max_xy".into(), json!(t.high.to_array()));
        for (list, frames) in [(OWN, &t.own), (SEEN, seen), ("test", &t.held_out)] {
            region.insert(list.into(), names(frames));
        }
        Value::from(region)
    });
    let regions: Vec<Value> = regions.collect();
    json!({ OWN: all(|t| &t.own), SEEN: all(|t| &t.own), "test": all(|t| &t.held_out), "regions": regions })
}

/// The points as a COLMAP model of text files, with the pictures that saw them; nothing where there are none.
///
/// # Errors
/// The folder cannot be written to.
pub fn write_points(root: &Path, set: &Dataset, points: &[SparsePoint]) -> Result<(), JobError> {
    let folder = root.join("sparse/0");
    if points.is_empty() {
        // Those of another data set must not stay.
        return match std::fs::remove_dir_all(&folder) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(JobError::io(&folder)(e)),
            _ => Ok(()),
        };
    }
    let (mut cameras, mut images, mut rows) = (String::new(), String::new(), String::new());
    // Writing to a string cannot fail.
    for (i, frame) in set.frames.iter().enumerate() {
        let k = &frame.view.intrinsics;
        _ = writeln!(cameras, "{i} PINHOLE {} {} {} {} {} {}", k.width, k.height, k.fx, k.fy, k.cx, k.cy);
        let r = frame.view.pose.rotation.conjugate();
        let t = -(r * frame.view.pose.center);
        let name = &frame.name;
        // The second line would hold its keypoints.
        _ = writeln!(images, "{i} {} {} {} {} {} {} {} {i} {name}\n", r.w, r.x, r.y, r.z, t.x, t.y, t.z);
    }
    for (i, point) in points.iter().enumerate() {
        let ([x, y, z], [r, g, b]) = (point.position, point.color);
        _ = write!(rows, "{i} {x} {y} {z} {r} {g} {b} {}", point.error_px);
        point.frames.iter().for_each(|frame| _ = write!(rows, " {frame} 0"));
        rows.push('\n');
    }
    for (name, text) in [("cameras", cameras), ("images", images), ("points3D", rows)] {
        write_text(&folder.join(name).with_extension("txt"), &text)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;
    use runtime::device_report::survey::write_data_set;

    #[test]
    fn regions_lists_and_points_come_back_as_they_were_given() {
        let dir = tempfile::tempdir().expect("temp dir");
        write_data_set(&dir.path().join("world"), 3, 0.1).expect("written");
        let set = Dataset::open(&dir.path().join("world")).expect("a data set");
        let territory = |name: &str, x: f64, own: Vec<usize>, held_out: Vec<usize>| {
            let (low, high) = (DVec2::new(x, -20.0), DVec2::new(x + 30.0, 20.0));
            Territory { name: name.into(), low, high, own, held_out }
        };
        let territories =
            [territory("west", -30.0, vec![0, 1, 6], vec![2]), territory("east", 0.0, vec![4, 5], vec![3])];
        let seen = [vec![0, 1, 4, 6], vec![4, 5]];
        let point = |x: f64, frames: Vec<u32>| SparsePoint {
            position: [x, 1.5, -0.25],
            color: [1, 20, 255],
            error_px: 0.5,
            frames,
        };
        let points = [point(-3.0, vec![0, 1]), point(3.0, vec![4, 5, 6])];
        let written = write(&dir.path().join("data"), &set, &territories, &seen, &points).expect("written");
        let back = &written.set;
        assert_eq!(back.frames.len(), set.frames.len());
        let order = |list: &str, region| back.select(list, region).expect(list);
        assert_eq!((order(OWN, None), order("test", None)), (vec![0, 1, 4, 5, 6], vec![2, 3]));
        assert_eq!((order(OWN, Some("west")), order(SEEN, Some("west"))), (vec![0, 1, 6], seen[0].clone()));
        assert_eq!((order("test", Some("east")), order(SEEN, Some("east"))), (vec![3], seen[1].clone()));
        assert_eq!(back.region("east").expect("there").polygon[2], [30.0, 20.0]);
        let of_west = back.sparse_points_of(&[0, 1, 6]).expect("points");
        assert_eq!(of_west.len(), 1, "two pictures of the west saw one of them");
        assert_eq!(
            (of_west[0].position, of_west[0].color, &of_west[0].frames),
            (points[0].position, points[0].color, &vec![0, 1])
        );
        let apart = back.frames[7].view.pose.center.distance(set.frames[7].view.pose.center);
        assert!(apart < 1e-9 && back.load(7, 1.0).is_ok(), "pictures stay where they lie");
        assert_eq!(back.origin, set.origin);
        // The same again is the same; another list is another data set.
        assert_eq!(
            write(&dir.path().join("data"), &set, &territories, &seen, &points).expect("again").content,
            written.content
        );
        let other =
            write(&dir.path().join("data"), &set, &territories, &[vec![0, 1, 6], vec![4, 5]], &points).expect("again");
        assert_ne!(other.content, written.content);
        write(&dir.path().join("data"), &set, &territories, &seen, &[]).expect("again");
        let without = Dataset::open(&dir.path().join("data")).expect("a data set");
        assert!(without.sparse_points().expect("read").is_empty(), "points of an earlier comparison stay");
        let over = write(&dir.path().join("world"), &set, &territories, &seen, &points);
        assert!(over.is_err_and(|e| e.to_string().contains("another --out")), "pictures are not written over");
    }
}
