//! Promises of model files in cells, and of those that an earlier dgtr wrote in one piece.
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
    assert!((2..=4).contains(&new), "{new} of {} pieces are new: the index and what changed", after.len());
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

/// Written by the dgtr of version 2 (`dgtr export s.dgtr --to delivery`), 114 of 120 random Gaussians of SH degree 1.
#[test]
fn a_rounded_model_of_version_2_is_read_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, include_bytes!("data/rounded_v2.dgtr")).unwrap();
    let (_, cloud) = model::read(&path).unwrap();
    let columns = [cloud.means.as_flattened(), cloud.log_scales.as_flattened(), cloud.rotations.as_flattened()];
    let bytes: Vec<u8> = columns
        .into_iter()
        .flatten()
        .chain(&cloud.opacity_logits)
        .chain(&cloud.sh)
        .flat_map(|v| v.to_le_bytes())
        .collect();
    // What that dgtr itself reads from it.
    assert_eq!(blake3::hash(&bytes).to_hex().as_str(), V2);
    assert_eq!(model::pieces(&path).unwrap(), None);
}

const V2: &str = "390bdfc7f92a06569a7a8873ce4981af10e223df0ba587e7485c77942c0c66a2";
