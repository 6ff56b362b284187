//! Promises about models whose chunks are cells.

use super::*;
use crate::testing::write_in_cells;

fn in_cells(b: &Bench, corner: f32, counter: u64, finished: bool) -> (OfferedModel, Vec<u8>) {
    let path = b.dir.path().join("source.dgtr");
    write_in_cells(&path, corner);
    let bytes = std::fs::read(&path).expect("read");
    (b.model(&bytes, counter, finished), bytes)
}

#[test]
fn a_cell_that_did_not_change_is_never_sent_again_not_even_after_a_restart() {
    let b = Bench::new();
    let ((first, _), (second, bytes)) = (in_cells(&b, 0.2, 1, false), in_cells(&b, 0.9, 2, true));
    let all = first.offer.chunks.len() as u64;
    let new = second.offer.chunks.iter().filter(|c| !first.offer.chunks.contains(c)).count() as u64;
    assert_eq!((new, all), (3, 7), "the index, the coarse layers and the cell that changed are new");
    b.publish(first);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    assert_eq!(r.counters.chunks, all);
    drop(r);
    b.publish(second);
    let mut r = b.receiver();
    b.rounds(&mut r, 2);
    assert!(r.all_finished());
    assert!(std::fs::read(&r.received()[0].path).expect("read") == bytes);
    assert_eq!((r.counters.chunks, r.counters.corrupt), (new, 0));
}

#[test]
fn the_index_comes_first_and_then_the_cells_by_importance() {
    let b = Bench::new();
    b.publish(in_cells(&b, 0.2, 1, true).0);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    let asked = b.fake.asked.lock().expect("lock").clone();
    assert_eq!(asked, (0..asked.len()).collect::<Vec<_>>());
}

#[test]
fn what_has_come_of_a_model_can_be_looked_at_until_it_is_complete() {
    let b = Bench::new();
    let (model, bytes) = in_cells(&b, 0.2, 1, true);
    let preview = b.dir.path().join("received/a1/preview.dgtr");
    // The index, the coarse layers and half of the rest.
    let chunks = model.offer.chunks.len();
    b.publish(model);
    b.fake.quota.store(2 + (chunks as u32 - 2) / 2, Ordering::SeqCst);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    assert!(r.received().is_empty());
    let (_, cloud, part) = models::formats::model::read_what_is_there(&preview).expect("a part of a model");
    let part = part.expect("not all of it");
    assert!(part.whole > 0 && part.whole < part.cells && part.whole + part.coarse == part.cells, "{part:?}");
    assert!(cloud.len() > 1000, "{}", cloud.len());
    assert!(bytes.starts_with(&std::fs::read(&preview).expect("read")));
    b.fake.quota.store(u32::MAX, Ordering::SeqCst);
    b.rounds(&mut r, 4);
    assert!(r.all_finished() && !preview.exists());
    // What is no model in cells has nothing to show in parts.
    b.publish(b.model(&noise(100_000, 3), 2, true));
    b.fake.quota.store(3, Ordering::SeqCst);
    b.rounds(&mut r, 1);
    assert!(!preview.exists());
}

#[test]
fn of_a_model_that_another_overtakes_nothing_is_left_to_look_at() {
    let b = Bench::new();
    let preview = b.dir.path().join("received/a1/preview.dgtr");
    b.publish(in_cells(&b, 0.2, 1, false).0);
    b.fake.quota.store(4, Ordering::SeqCst);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    assert!(preview.exists());
    // The last word of the flight, of which nothing comes.
    b.publish(b.model(&noise(100_000, 3), 2, true));
    b.fake.quota.store(0, Ordering::SeqCst);
    b.rounds(&mut r, 1);
    assert!(!preview.exists());
}

#[test]
fn cells_of_a_model_that_is_damaged_meanwhile_are_fetched_after_all() {
    let b = Bench::new();
    let ((first, old), (second, bytes)) = (in_cells(&b, 0.2, 1, false), in_cells(&b, 0.9, 2, true));
    b.publish(first);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    let mut spoilt = old;
    let middle = spoilt.len() / 2;
    spoilt[middle] ^= 1;
    std::fs::write(&r.received()[0].path, spoilt).expect("write");
    b.publish(second);
    b.rounds(&mut r, 6);
    assert!(r.all_finished() && r.counters.corrupt > 0);
    assert!(std::fs::read(&r.received()[0].path).expect("read") == bytes);
}
