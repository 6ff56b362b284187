//! Promises about models whose chunks are cells.

use super::*;
use crate::upload::testing::write_in_cells;

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
    assert_eq!((new, all), (2, 6), "the index and the cell that changed are new");
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
