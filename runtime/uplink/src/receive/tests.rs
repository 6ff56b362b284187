//! Promises of the ground's side, against an aircraft in memory that misbehaves on demand.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::*;
use crate::Source;
use crate::admission::ModelRefusal;
use crate::keys::Domain;
use crate::keys::Identity;
use crate::keys::testing::identities;
use crate::offer::{OfferedModel, Order};
use crate::receipt::{Delivery, Receipt};
use crate::testing::noise;
use crate::transport::{Patience, TransportError};

mod aircraft;
mod cells;
mod strangers;

use aircraft::{Bench, Fake};

#[test]
fn a_model_arrives_whole_and_is_confirmed() {
    let b = Bench::new();
    let bytes = noise(100_000, 1);
    b.publish(b.model(&bytes, 1, true));
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    assert!(r.all_finished());
    assert_eq!(std::fs::read(&r.received()[0].path).expect("read"), bytes);
    assert_eq!(b.fake.receipts.lock().expect("lock").len(), 1);
    assert_eq!(r.counters, ReceiveCounters { chunks: 7, bytes: 100_000, models: 1, ..Default::default() });
    assert_eq!(std::fs::read_dir(b.dir.path().join("received/a1/chunk")).expect("dir").count(), 0);
}

#[test]
fn corrupt_and_withheld_chunks_are_fetched_again() {
    let b = Bench::new();
    let bytes = noise(100_000, 2);
    b.publish(b.model(&bytes, 1, true));
    b.fake.corrupt.store(2, Ordering::SeqCst);
    b.fake.withhold.store(3, Ordering::SeqCst);
    let mut r = b.receiver();
    b.rounds(&mut r, 8);
    assert_eq!(std::fs::read(&r.received()[0].path).expect("read"), bytes);
    assert_eq!((r.counters.corrupt, r.counters.retries, r.counters.chunks), (2, 5, 7));
}

#[test]
fn a_killed_ground_station_resumes_with_what_it_has() {
    let b = Bench::new();
    let bytes = noise(100_000, 3);
    b.publish(b.model(&bytes, 1, true));
    b.fake.quota.store(4, Ordering::SeqCst);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    assert!(r.received().is_empty());
    assert_eq!(r.progress(), vec![("a1".to_owned(), 4, 7)]);
    drop(r);
    // One chunk goes bad on disk while the ground is down.
    let chunk = std::fs::read_dir(b.dir.path().join("received/a1/chunk")).expect("dir").flatten().next().expect("one");
    let mut spoiled = std::fs::read(chunk.path()).expect("read");
    spoiled[5] ^= 0x40;
    std::fs::write(chunk.path(), spoiled).expect("write");
    b.fake.quota.store(u32::MAX, Ordering::SeqCst);
    let mut r = b.receiver();
    b.rounds(&mut r, 4);
    assert_eq!(std::fs::read(&r.received()[0].path).expect("read"), bytes);
    assert_eq!((r.counters.chunks_reused, r.counters.chunks, r.counters.corrupt), (4, 4, 1));
    // A third start knows the model and fetches nothing.
    let mut r = b.receiver();
    b.rounds(&mut r, 2);
    assert!(r.all_finished());
    assert_eq!((r.counters.chunks, r.counters.duplicates), (0, 2));
}

#[test]
fn a_model_damaged_on_the_ground_is_fetched_again() {
    let b = Bench::new();
    b.publish(b.model(&noise(20_000, 4), 1, true));
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    let path = r.received()[0].path.clone();
    drop(r);
    std::fs::write(&path, b"half").expect("write");
    let mut r = b.receiver();
    assert!(r.received().is_empty());
    b.rounds(&mut r, 1);
    assert_eq!(std::fs::read(&path).expect("read").len(), 20_000);
}

#[test]
fn foreign_oversize_truncated_and_unknown_offers_are_counted_and_ignored() {
    let b = Bench::new();
    let path = b.dir.path().join("x");
    std::fs::write(&path, noise(20_000, 5)).expect("write");
    let wide = UploadSettings { max_model_mib: 16, chunk_kib: 64, ..b.settings.clone() };
    let offer = |mission, aircraft| {
        let order = Order { flight: 1, counter: 1 };
        OfferedModel::open(&path, &wide, &Source::unsigned(mission, aircraft), order, true)
            .expect("model")
            .offer
            .encode()
    };
    let good = offer("m", "a1");
    std::fs::write(&path, noise(2 << 20, 6)).expect("write");
    *b.fake.offers.lock().expect("lock") =
        vec![offer("m", "a1"), good[..good.len() - 9].to_vec(), vec![], noise(64, 7), vec![1; 1 << 20]];
    std::fs::write(&path, noise(20, 6)).expect("write");
    b.fake.offers.lock().expect("lock").extend([offer("other", "a1"), offer("m", "stranger")]);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    let c = r.counters;
    assert_eq!((c.foreign, c.unknown, c.oversize, c.damaged, c.chunks), (1, 1, 1, 4, 0));
}

#[test]
fn a_lying_offer_is_refused_once_and_does_not_replace_a_good_model() {
    let b = Bench::new();
    b.publish(b.model(&noise(20_000, 8), 1, true));
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    let mut liar = b.model(&noise(20_000, 9), 2, true);
    liar.offer.model = [7; 32];
    b.publish(liar);
    b.rounds(&mut r, 4);
    assert_eq!(r.received().len(), 1);
    assert_eq!(std::fs::read(&r.received()[0].path).expect("read"), noise(20_000, 8));
    assert_eq!((r.counters.chunks, r.counters.corrupt), (4, 1));
}

#[test]
fn an_older_offer_that_arrives_late_changes_nothing() {
    let b = Bench::new();
    let old = b.model(&noise(20_000, 10), 1, false);
    b.publish(b.model(&noise(20_000, 11), 2, true));
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    b.publish(old);
    b.rounds(&mut r, 2);
    assert!(r.all_finished());
    assert_eq!(std::fs::read(&r.received()[0].path).expect("read"), noise(20_000, 11));
}

#[test]
fn a_checkpoint_under_way_is_finished_before_the_next_but_not_before_the_last() {
    let b = Bench::new();
    b.publish(b.model(&noise(100_000, 12), 1, false));
    b.fake.quota.store(3, Ordering::SeqCst);
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    assert_eq!(r.progress()[0].1, 3);
    // The last model of the flight overtakes it, although the old one is only part here.
    b.publish(b.model(&noise(60_000, 13), 3, true));
    b.fake.quota.store(u32::MAX, Ordering::SeqCst);
    b.rounds(&mut r, 3);
    assert!(r.all_finished());
    assert_eq!(std::fs::read(&r.received()[0].path).expect("read"), noise(60_000, 13));
}

#[test]
fn the_same_bytes_offered_again_as_final_are_not_fetched_again() {
    let b = Bench::new();
    b.publish(b.model(&noise(60_000, 14), 1, false));
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    assert!(!r.all_finished() && r.received().len() == 1);
    b.publish(b.model(&noise(60_000, 14), 2, true));
    b.rounds(&mut r, 2);
    assert!(r.all_finished());
    assert_eq!(r.counters.chunks, 4);
    assert_eq!(b.fake.receipts.lock().expect("lock").len(), 2);
}

fn bytes_here(r: &Receiver) -> Vec<u8> {
    std::fs::read(&r.received()[0].path).expect("read")
}

#[test]
fn two_models_of_the_same_number_do_not_take_turns() {
    let b = Bench::new();
    b.publish(b.model(&noise(20_000, 28), 1, false));
    let mut r = b.receiver();
    b.rounds(&mut r, 1);
    b.publish(b.model(&noise(20_000, 29), 1, false));
    b.rounds(&mut r, 2);
    assert_eq!((bytes_here(&r), r.counters.models, r.counters.stale), (noise(20_000, 28), 1, 2));
}

#[test]
fn a_model_under_way_is_pinned_through_failures_and_let_go_when_nobody_holds_it() {
    let b = Bench::new();
    b.publish(b.model(&noise(100_000, 30), 1, false));
    b.fake.quota.store(3, Ordering::SeqCst);
    let mut r = b.receiver();
    b.rounds(&mut r, 3);
    assert_eq!(r.progress()[0], ("a1".into(), 3, 7));
    // A newer checkpoint while the link fails: the older one stays the one that is fetched.
    b.publish(b.model(&noise(80_000, 31), 2, false));
    b.rounds(&mut r, 3);
    assert_eq!(r.progress()[0], ("a1".into(), 3, 7));
    // The aircraft restarts and has the newer one only.
    b.fake.models.lock().expect("lock").remove(0);
    b.fake.quota.store(u32::MAX, Ordering::SeqCst);
    b.rounds(&mut r, 4);
    assert_eq!(bytes_here(&r), noise(80_000, 31));
}

#[test]
fn a_vanished_aircraft_does_not_hold_up_the_others() {
    let b = Bench::new();
    let stuck = Arc::new(Fake::default());
    let settings = UploadSettings { poll_s: 0.05, ..b.settings.clone() };
    for (id, hold) in [("a1", true), ("a2", false)] {
        let path = b.dir.path().join(id);
        std::fs::write(&path, noise(100_000, 32)).expect("write");
        let order = Order { flight: 1, counter: 1 };
        let model = OfferedModel::open(&path, &settings, &Source::unsigned("m", id), order, true).expect("model");
        stuck.offers.lock().expect("lock").push(model.offer.encode());
        if !hold {
            stuck.models.lock().expect("lock").push(model);
        }
    }
    struct Vanished(Arc<Fake>);
    impl Inlet for Vanished {
        fn name(&self) -> String {
            "vanished".into()
        }

        fn offers(&self, patience: Patience, see: &mut dyn FnMut(&[u8])) -> Result<(), TransportError> {
            self.0.offers(patience, see)
        }

        fn chunk(
            &self,
            offer: &Offer,
            index: usize,
            patience: Patience,
            accept: &mut dyn FnMut(&[u8]) -> bool,
        ) -> Result<Vec<u8>, TransportError> {
            // a1 never answers, and this is how long anybody waits for it.
            while offer.aircraft == "a1" && !patience.stop.load(Ordering::Relaxed) {
                std::thread::sleep(LOOK_UP);
            }
            self.0.chunk(offer, index, patience, accept)
        }

        fn deliver_receipt(
            &self,
            aircraft: &str,
            receipt: &[u8],
            patience: Patience,
            accept: &mut dyn FnMut(&[u8]) -> bool,
        ) -> Result<(), TransportError> {
            self.0.deliver_receipt(aircraft, receipt, patience, accept)
        }
    }
    stuck.quota.store(u32::MAX, Ordering::SeqCst);
    let (mission, aircraft) = ("m".into(), vec!["a1".into(), "a2".into()]);
    let admission = Admission {
        mission,
        aircraft,
        identity: Identity::unsigned(),
        check: Box::new(|_, _| Ok(())),
        memory: Default::default(),
    };
    let inlets: Vec<Box<dyn Inlet>> = vec![Box::new(Vanished(stuck))];
    let dir = b.dir.path().join("received");
    let mut r = Receiver::with_inlets(&settings, admission, &dir, inlets, sync_channel(1)).expect("receiver");
    for _ in 0..50 {
        r.round(&AtomicBool::new(false)).expect("round");
        if !r.received().is_empty() {
            break;
        }
    }
    assert_eq!(r.received()[0].aircraft, "a2");
}

#[test]
fn one_aircraft_that_cannot_be_written_costs_the_others_nothing_and_is_tried_again() {
    let b = Bench::new();
    let path = b.dir.path().join("source-2.dgtr");
    std::fs::write(&path, noise(60_000, 15)).expect("write");
    let (source, order) = (Source::unsigned("m", "a2"), Order { flight: 1, counter: 1 });
    let second = OfferedModel::open(&path, &b.settings, &source, order, true).expect("model");
    b.publish(b.model(&noise(60_000, 14), 1, true));
    b.show_too(second);
    // In the place of a1's folder stands something else.
    let dir = b.dir.path().join("received");
    std::fs::create_dir(&dir).expect("folder");
    std::fs::write(dir.join("a1"), b"").expect("in the way");
    let (mission, aircraft) = ("m".into(), vec!["a1".into(), "a2".into()]);
    let admission = Admission {
        mission,
        aircraft,
        identity: Identity::unsigned(),
        check: Box::new(|_, _| Ok(())),
        memory: Default::default(),
    };
    let inlets: Vec<Box<dyn Inlet>> = vec![Box::new(b.fake.clone())];
    let mut r = Receiver::with_inlets(&b.settings, admission, &dir, inlets, sync_channel(1)).expect("receiver");
    b.rounds(&mut r, 3);
    let here: Vec<String> = r.received().into_iter().map(|m| m.aircraft).collect();
    assert_eq!(here, ["a2"]);
    assert!(r.counters.disk > 0 && !r.all_finished());
    std::fs::remove_file(dir.join("a1")).expect("out of the way");
    b.rounds(&mut r, 3);
    assert!(r.all_finished(), "it goes on by itself");
}

/// One who never answered made every look last ten seconds, and each transfer wait for it.
#[test]
fn whoever_never_answers_delays_neither_offers_nor_transfers_nor_the_end() {
    let b = Bench::new();
    struct Silent(Arc<Fake>);
    impl Inlet for Silent {
        fn name(&self) -> String {
            "somebody who never answers, among others".into()
        }

        fn offers(&self, patience: Patience, see: &mut dyn FnMut(&[u8])) -> Result<(), TransportError> {
            self.0.offers(patience, see)?;
            while !patience.stop.load(Ordering::Relaxed) {
                std::thread::sleep(LOOK_UP);
            }
            Ok(())
        }

        fn chunk(
            &self,
            offer: &Offer,
            index: usize,
            patience: Patience,
            accept: &mut dyn FnMut(&[u8]) -> bool,
        ) -> Result<Vec<u8>, TransportError> {
            self.0.chunk(offer, index, patience, accept)
        }

        fn deliver_receipt(
            &self,
            aircraft: &str,
            receipt: &[u8],
            patience: Patience,
            accept: &mut dyn FnMut(&[u8]) -> bool,
        ) -> Result<(), TransportError> {
            self.0.deliver_receipt(aircraft, receipt, patience, accept)
        }
    }
    let settings = UploadSettings { poll_s: 0.3, ..b.settings.clone() };
    let inlets: Vec<Box<dyn Inlet>> = vec![Box::new(Silent(b.fake.clone()))];
    let dir = b.dir.path().join("received");
    let (mission, aircraft, memory) = ("m".into(), vec!["a1".into()], Default::default());
    let identity = Identity::unsigned();
    let admission = Admission { mission, aircraft, identity, check: Box::new(|_, _| Ok(())), memory };
    let mut r = Receiver::with_inlets(&settings, admission, &dir, inlets, sync_channel(1)).expect("receiver");
    b.publish(b.model(&noise(100_000, 40), 1, false));
    b.rounds(&mut r, 2);
    assert_eq!(bytes_here(&r), noise(100_000, 40));
    // The last model is found although the first looks still wait.
    b.publish(b.model(&noise(60_000, 41), 2, true));
    let mut rounds = 0;
    while !r.all_finished() && rounds < 40 {
        b.rounds(&mut r, 1);
        rounds += 1;
    }
    assert_eq!(bytes_here(&r), noise(60_000, 41));
    assert_eq!((r.counters.models, r.counters.retries), (2, 0));
}
