//! Promises of levels of detail: what is written is what a viewer of streamed SOG expects, all of the scene is in it, and what is read in
//! pieces is the model.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;

use models::cloud::GaussianCloud;
use models::formats::FormatError;
use models::formats::delivery::Rounding;
use models::formats::model::{self, Chunks, ModelHeader};
use models::levels;
use serde_json::Value;

/// Rolling ground, `side` by `side` Gaussians half a metre apart.
fn ground(side: usize, degree: u8) -> GaussianCloud {
    let mut cloud = GaussianCloud::with_capacity(degree, side * side);
    for i in 0..side * side {
        let (x, y) = (0.5 * (i % side) as f32, 0.5 * (i / side) as f32);
        let sh: Vec<f32> = (0..cloud.sh_stride()).map(|k| 0.3 * (x * 0.1 + k as f32).sin()).collect();
        cloud.push([900.0 + x, y, 3.0 * (x * 0.05).sin()], [-1.2, -1.2, -4.0], [1.0, 0.1, 0.0, 0.0], 2.0, &sh);
    }
    cloud
}

fn chunks_of(cloud: &GaussianCloud, folder: &Path) -> Chunks {
    let path = folder.join("model.dgtr");
    model::write(&path, &ModelHeader::default(), cloud).unwrap();
    Chunks::open(&path).unwrap()
}

fn pieces(chunks: &Chunks) -> (GaussianCloud, usize, u64) {
    let (mut all, mut pieces) = (GaussianCloud::with_capacity(chunks.sh_degree, 0), 0);
    let each = &mut |cloud: &mut GaussianCloud| {
        all.extend(cloud);
        pieces += 1;
        Ok::<(), FormatError>(())
    };
    let dropped = chunks.each(each).unwrap();
    (all, pieces, dropped)
}

#[test]
fn a_model_read_in_pieces_is_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = ground(200, 1);
    cloud.means[17][1] = f32::NAN;
    let exact = chunks_of(&cloud, folder.path());
    let (all, n, dropped) = pieces(&exact);
    assert!(n > 1 && dropped == 1);
    let (_, whole) = model::read(&folder.path().join("model.dgtr")).unwrap();
    assert!(all == whole && pieces(&exact).0 == all);

    let delivery = folder.path().join("delivery.dgtr");
    model::write_rounded(&Default::default(), &delivery, &ModelHeader::default(), &all, &Rounding::default()).unwrap();
    let (cells, n, _) = pieces(&Chunks::open(&delivery).unwrap());
    assert!(n > 1 && cells == model::read(&delivery).unwrap().1);
}

#[test]
fn a_model_written_in_chunks_is_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = ground(150, 1);
    let [whole, chunks] = ["whole", "chunks"].map(|n| folder.path().join(n));
    model::write(&whole, &ModelHeader::default(), &cloud).unwrap();
    let rows = |range: std::ops::Range<usize>| {
        let mut part = cloud.clone();
        let mut row = 0;
        part.retain(|_| {
            row += 1;
            range.contains(&(row - 1))
        });
        part
    };
    model::write_chunks(&chunks, &ModelHeader::default(), cloud.len(), 1, &rows).unwrap();
    assert!(std::fs::read(&whole).unwrap() == std::fs::read(&chunks).unwrap());
    let short = |_: std::ops::Range<usize>| GaussianCloud::with_capacity(1, 0);
    assert!(model::write_chunks(&chunks, &ModelHeader::default(), 5, 1, &short).is_err());
}

/// Leaves of the tree, and whether every node's bound holds its children's.
fn leaves<'a>(node: &'a Value, into: &mut Vec<&'a Value>) {
    let corner = |n: &Value, at: &str, k: usize| n["bound"][at][k].as_f64().unwrap();
    let Some(children) = node["children"].as_array() else { return into.push(node) };
    for child in children {
        for k in 0..3 {
            assert!(
                corner(node, "min", k) <= corner(child, "min", k) && corner(node, "max", k) >= corner(child, "max", k)
            );
        }
        leaves(child, into);
    }
}

/// Heights, eastings and northings of a SOG folder's rows, as PlayCanvas' specification says.
fn means(folder: &Path) -> Vec<[f64; 3]> {
    let meta: Value = serde_json::from_slice(&std::fs::read(folder.join("meta.json")).unwrap()).unwrap();
    let picture = |k: usize| {
        let file = std::fs::File::open(folder.join(meta["means"]["files"][k].as_str().unwrap())).unwrap();
        let mut decoder = image_webp::WebPDecoder::new(std::io::BufReader::new(file)).unwrap();
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut pixels = vec![0; decoder.output_buffer_size().unwrap()];
        decoder.read_image(&mut pixels).unwrap();
        pixels.chunks(channels).map(|p| [p[0], p[1], p[2]].map(f64::from)).collect::<Vec<_>>()
    };
    let (low, high) = (picture(0), picture(1));
    let bound = |at: &str, k: usize| meta["means"][at][k].as_f64().unwrap();
    let value = |i: usize, k: usize| {
        let share = (low[i][k] + 256.0 * high[i][k]) / 65_535.0;
        let v = bound("mins", k) + share * (bound("maxs", k) - bound("mins", k));
        v.signum() * v.abs().exp_m1()
    };
    (0..meta["count"].as_u64().unwrap() as usize).map(|i| [0, 1, 2].map(|k| value(i, k))).collect()
}

#[test]
fn every_leaf_has_its_gaussians_at_every_level_where_the_index_says() {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = ground(700, 1);
    // A stray of the training, beyond the horizon.
    cloud.push([9e6, 0.0, 0.0], [0.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[0.0; 12]);
    let out = folder.path().join("streamed");
    let report = levels::write(&chunks_of(&cloud, folder.path()), &out, 1).unwrap();
    assert_eq!((report.strays, report.non_finite, report.counts[0]), (1, 0, 490_000));
    assert!(report.leaves > 4 && report.counts.len() >= 3, "{:?}", report.counts);
    let thinned = report.counts.windows(2).map(|n| n[0] as f64 / n[1] as f64);
    assert!(thinned.clone().all(|r| (3.0..8.0).contains(&r)), "{:?}", thinned.collect::<Vec<_>>());

    let meta: Value = serde_json::from_slice(&std::fs::read(out.join("lod-meta.json")).unwrap()).unwrap();
    assert_eq!((&meta["version"], &meta["lodLevels"]), (&1.into(), &report.counts.len().into()));
    assert_eq!(meta["counts"], serde_json::json!(report.counts));
    let files: Vec<Vec<[f64; 3]>> = meta["filenames"]
        .as_array()
        .unwrap()
        .iter()
        .map(|f| means(out.join(f.as_str().unwrap()).parent().unwrap()))
        .collect();
    let mut all = Vec::new();
    leaves(&meta["tree"], &mut all);
    assert_eq!(all.len(), report.leaves);
    let mut used = vec![0; files.len()];
    for leaf in &all {
        let bound = |at: &str, k: usize| leaf["bound"][at][k].as_f64().unwrap();
        for (level, rows) in leaf["lods"].as_object().unwrap() {
            let number = |what: &str| rows[what].as_u64().unwrap() as usize;
            let (file, offset, count) = (number("file"), number("offset"), number("count"));
            assert!(meta["filenames"][file].as_str().unwrap().starts_with(&format!("{level}_")));
            used[file] += count;
            for mean in &files[file][offset..offset + count] {
                // 16 bits between the file's bounds.
                let inside = (0..3).all(|k| mean[k] > bound("min", k) - 0.02 && mean[k] < bound("max", k) + 0.02);
                assert!(inside, "{mean:?} of level {level} is outside of {}", leaf["bound"]);
            }
        }
        assert_eq!(leaf["lods"].as_object().unwrap().len(), report.counts.len(), "every level of every leaf");
    }
    assert_eq!(used, files.iter().map(Vec::len).collect::<Vec<_>>());
}

#[test]
fn a_scene_that_cannot_be_read_leaves_no_index_and_is_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.dgtr");
    let out = folder.path().join("streamed");
    levels::write(&chunks_of(&ground(20, 0), folder.path()), &out, 0).unwrap();
    assert!(out.join("lod-meta.json").exists());

    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&path, &bytes).unwrap();
    assert!(matches!(Chunks::open(&path), Err(FormatError::Damaged { .. })));

    let empty = chunks_of(&GaussianCloud::with_capacity(0, 0), folder.path());
    let said = levels::write(&empty, &folder.path().join("none"), 0).unwrap_err().to_string();
    assert!(said.contains("no Gaussians") && !said.contains('\n'), "{said}");
    assert!(!folder.path().join("none/lod-meta.json").exists());
}
