//! Promises of registration as a whole, with a fitter that knows the truth and counts.

use std::path::Path;

use disk::Disk;
use glam::DVec3;

use super::*;
use crate::frame::Motion;
use crate::member::Member;
use crate::testing::{carpet, model, written};

/// What is wrong with the telemetry of the aircraft at a column and row.
fn error(at: [usize; 2]) -> DVec3 {
    let wobble = |k: f64| ((at[0] as f64 * 3.7 + at[1] as f64 * 1.9 + k) * 2.1).sin();
    DVec3::new(2.0 * wobble(0.0), 2.0 * wobble(1.0), wobble(2.0))
}

fn place(member: &Member) -> [usize; 2] {
    let mut parts = member.name().split('-').skip(1).map(|n| n.parse().expect("a number"));
    [parts.next().expect("column"), parts.next().expect("row")]
}

/// An aircraft of a field: 60 m of ground, 40 m beside the next one, off by its error.
fn aircraft(dir: &Path, at: [usize; 2], spacing: f64) -> Member {
    let [x, y] = at.map(|n| n as f64 * 40.0);
    let mut local = model(&format!("a-{}-{}", at[0], at[1]), &[], carpet([x, y], [x + 60.0, y + 60.0], spacing));
    Motion::rigid(glam::DQuat::IDENTITY, error(at)).cloud(&mut local.cloud);
    written(dir, &local)
}

/// Fits exactly but for the pairs it is told to lie about.
#[derive(Default)]
struct Exact {
    fits: usize,
    lies: Vec<[[usize; 2]; 2]>,
}

impl Fitter for &mut Exact {
    fn fit(&mut self, first: &Member, second: &Member) -> Result<Option<Fitted>, String> {
        self.fits += 1;
        let (a, b) = (place(first), place(second));
        let lie = self.lies.iter().any(|l| *l == [a, b] || *l == [b, a]);
        let lie = if lie { DVec3::new(6.0, 4.0, 0.0) } else { DVec3::ZERO };
        let shift = error(a) - error(b) + lie;
        let middle = 0.5 * (first.middle() + second.middle());
        let places = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z, -DVec3::Z].map(|d| (middle + 9.0 * d).into());
        let points = [500, 700];
        let turn = glam::DQuat::IDENTITY.to_array();
        Ok(Some(Fitted { turn, scale: 1.0, shift: shift.into(), places, points, rms_m: [shift.length(), 0.05] }))
    }
}

fn registrar<'a>(dir: &Path, exact: &'a mut Exact) -> Registrar<&'a mut Exact> {
    Registrar::new(Edges::open(&Disk::default(), &dir.join("registration")), exact)
}

fn field(dir: &Path, columns: usize, rows: usize) -> Vec<Member> {
    (0..columns * rows).map(|i| aircraft(dir, [i % columns, i / columns], 2.0)).collect()
}

/// How far neighbours are from agreeing, metres: where they put the place between them.
fn worst_disagreement(members: &[Member]) -> f64 {
    let truth = |m: &Member| DVec3::new(place(m)[0] as f64 * 40.0 + 30.0, place(m)[1] as f64 * 40.0 + 30.0, 0.0);
    let mut worst = 0.0f64;
    for (a, b) in members.iter().flat_map(|a| members.iter().map(move |b| (a, b))) {
        let between = 0.5 * (truth(a) + truth(b));
        if truth(a).distance(truth(b)) < 60.0 {
            let put = |m: &Member| m.motion().point(between + error(place(m)));
            worst = worst.max(put(a).distance(put(b)));
        }
    }
    worst
}

/// 24 aircraft; 64 were the most, and each round fitted every pair: 2,024 fits for 23 of 24.
#[test]
fn each_pair_of_neighbours_is_fitted_once_and_an_aircraft_that_joins_fits_its_own_edges_only() {
    let dir = tempfile::tempdir().expect("temp dir");
    let members = field(dir.path(), 6, 4);
    let mut exact = Exact::default();
    let mut registrar = registrar(dir.path(), &mut exact);
    let fitted = registrar.fit(&members[..23], &|| false).expect("fitted");
    // Beside, above and across; the corner aircraft of the last row is missing.
    assert_eq!(fitted, 5 * 4 + 6 * 3 + 2 * 5 * 3 - 3);
    assert_eq!(registrar.fit(&members[..23], &|| false), Ok(0));
    let before = worst_disagreement(&members);
    let mut all = members;
    let report = registrar.register(&mut all, &Held::default(), &|| false).expect("registered");
    assert_eq!((report.fitted, report.pairs, report.models.len()), (3, fitted + 3, 24));
    assert!(report.warnings.is_empty(), "{:?}", report.warnings);
    let after = worst_disagreement(&all);
    assert!(before > 3.0 && after < 0.02, "{before} m, then {after} m");
    drop(registrar);
    assert_eq!(exact.fits, fitted + 3);
}

#[test]
fn a_restart_keeps_every_edge_and_a_new_version_of_a_model_asks_for_its_own_again() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut members = field(dir.path(), 4, 3);
    let mut exact = Exact::default();
    let first =
        registrar(dir.path(), &mut exact).register(&mut members, &Held::default(), &|| false).expect("registered");
    let mut again = field(dir.path(), 4, 3);
    let second =
        registrar(dir.path(), &mut exact).register(&mut again, &Held::default(), &|| false).expect("registered");
    assert_eq!((second.fitted, second.pairs), (0, first.pairs));
    assert_eq!(
        members.iter().map(|m| *m.motion()).collect::<Vec<_>>(),
        again.iter().map(|m| *m.motion()).collect::<Vec<_>>()
    );
    // Given in another order, too.
    let mut reversed = field(dir.path(), 4, 3);
    reversed.reverse();
    assert_eq!(registrar(dir.path(), &mut exact).fit(&reversed, &|| false), Ok(0));
    // The corner has three neighbours.
    again = field(dir.path(), 4, 3);
    again[0] = aircraft(dir.path(), [0, 0], 1.9);
    let third =
        registrar(dir.path(), &mut exact).register(&mut again, &Held::default(), &|| false).expect("registered");
    assert_eq!((third.fitted, third.pairs), (3, first.pairs));
    let files = std::fs::read_dir(dir.path().join("registration")).expect("folder").count();
    assert_eq!(files, first.pairs, "edges of the version before are forgotten");
}

#[test]
fn a_damaged_edge_is_named_and_fitted_again() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut members = field(dir.path(), 2, 2);
    let mut exact = Exact::default();
    let report =
        registrar(dir.path(), &mut exact).register(&mut members, &Held::default(), &|| false).expect("registered");
    assert_eq!(report.pairs, 6);
    let folder = dir.path().join("registration");
    let mut files: Vec<_> = std::fs::read_dir(&folder).expect("folder").map(|e| e.expect("entry").path()).collect();
    files.sort();
    let good = std::fs::read(&files[0]).expect("read");
    std::fs::write(&files[0], &good[..good.len() - 1]).expect("cut");
    let mut flipped = std::fs::read(&files[1]).expect("read");
    flipped[60] ^= 4;
    std::fs::write(&files[1], flipped).expect("flip");
    std::fs::write(&files[2], &good).expect("of another pair");
    std::fs::write(&files[3], vec![0; 1 << 20]).expect("too long");
    let mut again = field(dir.path(), 2, 2);
    let report =
        registrar(dir.path(), &mut exact).register(&mut again, &Held::default(), &|| false).expect("registered");
    assert_eq!((report.fitted, report.warnings.len()), (4, 4));
    for (file, why) in files.iter().zip(["checksum", "checksum", "another pair", "long"]) {
        let name = file.file_name().and_then(|n| n.to_str()).expect("a name");
        assert!(report.warnings.iter().any(|w| w.contains(name) && w.contains(why)), "{why}: {:?}", report.warnings);
    }
    assert_eq!(registrar(dir.path(), &mut exact).fit(&again, &|| false), Ok(0));
}

#[test]
fn a_false_edge_is_named_and_the_others_hold() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut members = field(dir.path(), 4, 4);
    let mut exact = Exact { lies: vec![[[1, 1], [2, 1]]], ..Default::default() };
    let report =
        registrar(dir.path(), &mut exact).register(&mut members, &Held::default(), &|| false).expect("registered");
    assert_eq!(report.warnings.len(), 1, "{:?}", report.warnings);
    assert!(report.warnings[0].contains("a-1-1") && report.warnings[0].contains("a-2-1"));
    assert!(worst_disagreement(&members) < 0.02, "{}", worst_disagreement(&members));
}

#[test]
fn aircraft_far_from_each_other_are_never_fitted() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut members: Vec<Member> = [[0, 0], [5, 0], [0, 5]].map(|at| aircraft(dir.path(), at, 2.0)).into();
    let mut exact = Exact::default();
    let report =
        registrar(dir.path(), &mut exact).register(&mut members, &Held::default(), &|| false).expect("registered");
    assert_eq!((report.pairs, report.models.len(), exact.fits), (0, 0, 0));
    assert!(members.iter().all(|m| *m.motion() == Motion::NONE));
    assert!(!dir.path().join("registration").exists());
}
