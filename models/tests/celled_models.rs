//! Promises of model files in cells.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use models::cloud::GaussianCloud;
use models::formats::delivery::Rounding;
use models::formats::model::{self, ModelHeader};
use rand::{Rng, SeedableRng};

fn cloud(n: usize) -> GaussianCloud {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
    let mut cloud = GaussianCloud::with_capacity(1, n);
    for _ in 0..n {
        let mut number = |size: f32| rng.random_range(-size..size);
        let (mean, scales) = ([number(60.0), number(60.0), number(3.0)], [(); 3].map(|()| number(0.8) - 2.0));
        let (rotation, sh) = ([1.0, number(1.0), number(1.0), number(1.0)], [(); 12].map(|()| number(0.5)));
        cloud.push(mean, scales, rotation, number(4.0), &sh);
    }
    cloud
}

#[test]
fn a_file_in_cells_is_sent_in_pieces_that_are_its_cells() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    let all = cloud(20_000);
    let write = |cloud: &GaussianCloud| {
        model::write_rounded(&Default::default(), &path, &ModelHeader::default(), cloud, &Rounding::default()).unwrap();
        let (bytes, pieces) = (std::fs::read(&path).unwrap(), model::pieces(&path).unwrap().unwrap());
        let mut left = &bytes[..];
        let cut: Vec<Vec<u8>> = pieces.iter().map(|n| left.split_off(..*n as usize).unwrap().to_vec()).collect();
        assert!(left.is_empty());
        cut
    };
    let before = write(&all);
    assert!(before.len() > 4, "{} pieces", before.len());
    assert_eq!(model::read(&path).unwrap().1.len(), 20_000);
    let mut changed = all;
    (0..changed.len())
        .filter(|i| changed.means[*i][0] > 45.0 && changed.means[*i][1] > 45.0)
        .for_each(|i| changed.sh[12 * i] += 0.4);
    let after = write(&changed);
    let new = after.iter().filter(|piece| !before.contains(piece)).count();
    assert!(
        (3..=6).contains(&new),
        "{new} of {} pieces are new: the index, coarse layers and what changed",
        after.len()
    );
    let exact = dir.path().join("exact.dgtr");
    model::write(&exact, &ModelHeader::default(), &changed).unwrap();
    assert_eq!(model::pieces(&exact).unwrap(), None);
}

#[test]
fn no_damage_to_a_file_in_cells_goes_unseen() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    model::write_rounded(&Default::default(), &path, &ModelHeader::default(), &cloud(300), &Rounding::default())
        .unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        model::read(&path)
    };
    assert!(read(&bytes).is_ok());
    for at in 0..bytes.len() {
        let mut spoilt = bytes.clone();
        spoilt[at] ^= 0x41;
        assert!(read(&spoilt).is_err(), "byte {at}");
    }
    for n in (0..bytes.len()).step_by(7) {
        let refused = read(&bytes[..n]).map(drop).unwrap_err().to_string();
        assert!(!refused.contains('\n'), "{refused}");
    }
    assert!(read(&[&bytes[..], &[0; 4]].concat()).is_err());
}

#[test]
fn whatever_part_of_a_file_in_layers_is_there_shows_the_whole_scene() {
    let dir = tempfile::tempdir().unwrap();
    let (path, all) = (dir.path().join("m.dgtr"), cloud(40_000));
    model::write_rounded(&Default::default(), &path, &ModelHeader::default(), &all, &Rounding::default()).unwrap();
    let (bytes, pieces) = (std::fs::read(&path).unwrap(), model::pieces(&path).unwrap().unwrap());
    let whole = model::read_what_is_there(&path).unwrap();
    assert_eq!((whole.1.len(), whole.2), (40_000, None));
    let index = pieces[0] as usize;
    let part = |n: usize| {
        std::fs::write(&path, &bytes[..n]).unwrap();
        assert!(model::read(&path).is_err(), "who goes on with a model is not given a part of one");
        let (header, cloud, part) = model::read_what_is_there(&path).unwrap();
        assert_eq!(header, ModelHeader::default());
        (cloud, part.unwrap())
    };
    let covered = |cloud: &GaussianCloud| (0..cloud.len()).map(|i| cloud.covered_m2(i)).sum::<f64>();
    let (nothing, model::Partial { cells, whole: 0, coarse: 0 }) = part(index) else {
        panic!("cells before their index")
    };
    assert_eq!(nothing.len(), 0);
    // The last byte of the last coarse layer, and of the second cell.
    let first_with = |wanted: fn(&model::Partial) -> bool| {
        let (mut low, mut high) = (index, bytes.len() - 1);
        while low < high {
            let middle = low.midpoint(high);
            if wanted(&part(middle).1) { high = middle } else { low = middle + 1 }
        }
        low
    };
    let coarse = first_with(|p| p.coarse + p.whole == p.cells);
    let second = first_with(|p| p.whole >= 2);
    assert!(cells > 4 && 10 * coarse < bytes.len(), "{coarse} of {} bytes for {cells} coarse layers", bytes.len());
    // Coarse layers are sent together, each cell on its own.
    assert!((cells + 2..cells + 5).contains(&pieces.len()), "{} pieces of {cells} cells", pieces.len());
    // Merged, what they cover stays.
    let (merged, there) = part(coarse);
    assert_eq!(there, model::Partial { cells, whole: 0, coarse: cells });
    assert!((1000..8000).contains(&merged.len()), "{}", merged.len());
    let share = covered(&merged) / covered(&all);
    assert!((0.5..1.5).contains(&share), "{share}");
    // Cells take their layers' places one by one, and half a cell is none.
    assert_eq!(part(second).1, model::Partial { cells, whole: 2, coarse: cells - 2 });
    assert_eq!(part(second - 1).1, model::Partial { cells, whole: 1, coarse: cells - 1 });
    let counts: Vec<usize> = (coarse..bytes.len()).step_by(bytes.len() / 9).map(|n| part(n).0.len()).collect();
    assert!(counts.is_sorted() && counts[0] < counts[counts.len() - 1], "{counts:?}");
    // What is cut before the index is whole is refused, as is damage in what is there.
    std::fs::write(&path, &bytes[..index - 1]).unwrap();
    assert!(model::read_what_is_there(&path).is_err());
    let mut spoilt = bytes[..second].to_vec();
    for at in [index / 2, index + 5, coarse + 5] {
        spoilt[at] ^= 0x41;
        std::fs::write(&path, &spoilt).unwrap();
        assert!(model::read_what_is_there(&path).is_err(), "byte {at}");
        spoilt[at] ^= 0x41;
    }
}

#[test]
fn a_file_of_another_version_is_refused_with_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    model::write(&path, &ModelHeader::default(), &cloud(3)).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    for version in [0u8, 2, 3, 5] {
        bytes[8] = version;
        std::fs::write(&path, &bytes).unwrap();
        let error = model::read(&path).unwrap_err().to_string();
        assert!(
            error.contains(&format!("version {version};")) && error.contains("use the dgtr that wrote it"),
            "{error}"
        );
    }
}
