//! Promises of the ground's side, against an aircraft in memory that misbehaves on demand.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use super::*;
use crate::keys::Domain;
use crate::keys::Identity;
use crate::keys::testing::identities;
use crate::upload::Source;
use crate::upload::admission::ModelRefusal;
use crate::upload::offer::{OfferedModel, Order};
use crate::upload::receipt::{Delivery, Receipt};
use crate::upload::testing::noise;
use crate::upload::transport::TransportError;

#[derive(Default)]
struct Fake {
    offers: Mutex<Vec<Vec<u8>>>,
    models: Mutex<Vec<OfferedModel>>,
    /// Chunk replies to spoil or withhold before behaving.
    corrupt: AtomicU32,
    withhold: AtomicU32,
    /// Serve at most this many chunks, then act as if out of range.
    quota: AtomicU32,
    /// How many answer every question with garbage before the aircraft does.
    liars: AtomicU32,
    asked: Mutex<Vec<usize>>,
    receipts: Mutex<Vec<Vec<u8>>>,
    /// The aircraft's.
    identity: Mutex<Identity>,
}

fn take(n: &AtomicU32) -> bool {
    n.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |v| v.checked_sub(1)).is_ok()
}

impl Inlet for Arc<Fake> {
    fn name(&self) -> String {
        "fake".into()
    }

    fn offers(&self, _: Patience, see: &mut dyn FnMut(&[u8])) -> Result<(), TransportError> {
        self.offers.lock().expect("lock").iter().for_each(|bytes| see(bytes));
        Ok(())
    }

    fn chunk(
        &self,
        offer: &Offer,
        index: usize,
        _: Patience,
        accept: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<Vec<u8>, TransportError> {
        if take(&self.withhold) || !take(&self.quota) {
            return Err(TransportError::Network("out of range".into()));
        }
        let liars = self.liars.load(Ordering::SeqCst);
        // Whoever lies answers first, and with bytes of the right length.
        (0..liars).for_each(|_| assert!(!accept(&vec![0; offer.chunk_len(index) as usize])));
        let models = self.models.lock().expect("lock");
        let model = models.iter().find(|m| m.offer.model == offer.model);
        let model = model.ok_or(TransportError::NotHeld(offer.chunks[index]))?;
        self.asked.lock().expect("lock").push(index);
        let mut bytes = model.chunk(index).expect("chunk");
        if take(&self.corrupt) {
            bytes[0] ^= 1;
        }
        if accept(&bytes) { Ok(bytes) } else { Err(TransportError::Corrupt(offer.chunks[index])) }
    }

    fn deliver_receipt(
        &self,
        _: &str,
        receipt: &[u8],
        _: Patience,
        accept: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<(), TransportError> {
        // A false signature for it comes first.
        if self.liars.load(Ordering::SeqCst) > 0 && accept(&[0; 64]) {
            return Ok(());
        }
        let identity = self.identity.lock().expect("lock").clone();
        let answer = identity.sign(Domain::Acknowledgement, receipt).map_or(Vec::new(), |s| s.to_vec());
        assert!(accept(&answer));
        self.receipts.lock().expect("lock").push(receipt.to_vec());
        Ok(())
    }
}

struct Bench {
    dir: tempfile::TempDir,
    fake: Arc<Fake>,
    settings: UploadSettings,
}

impl Bench {
    fn new() -> Self {
        let settings = UploadSettings {
            chunk_kib: 16,
            max_model_mib: 1,
            retry_min_s: 0.001,
            retry_max_s: 0.002,
            poll_s: 5.0,
            ..Default::default()
        };
        let fake = Arc::new(Fake::default());
        fake.quota.store(u32::MAX, Ordering::SeqCst);
        Self { dir: tempfile::tempdir().expect("temp dir"), fake, settings }
    }

    fn model(&self, bytes: &[u8], counter: u64, finished: bool) -> OfferedModel {
        self.model_of(&self.fake.identity.lock().expect("lock").clone(), bytes, counter, finished)
    }

    fn model_of(&self, identity: &Identity, bytes: &[u8], counter: u64, finished: bool) -> OfferedModel {
        let path = self.dir.path().join("source.dgtr");
        std::fs::remove_file(&path).ok();
        std::fs::write(&path, bytes).expect("write");
        let source = Source { identity: identity.clone(), ..Source::unsigned("m", "a1") };
        OfferedModel::open(&path, &self.settings, &source, Order { flight: 1, counter }, finished).expect("model")
    }

    fn show_too(&self, model: OfferedModel) {
        self.fake.offers.lock().expect("lock").insert(0, model.offer.encode());
        self.fake.models.lock().expect("lock").push(model);
    }

    fn publish(&self, model: OfferedModel) {
        *self.fake.offers.lock().expect("lock") = vec![model.offer.encode()];
        self.fake.models.lock().expect("lock").push(model);
    }

    fn receiver(&self) -> Receiver {
        self.receiver_of(Identity::unsigned(), |_, _| Ok(()))
    }

    fn receiver_of(
        &self,
        identity: Identity,
        check: impl Fn(&str, &Path) -> Result<(), ModelRefusal> + Send + Sync + 'static,
    ) -> Receiver {
        let inlets: Vec<Box<dyn Inlet>> = vec![Box::new(self.fake.clone())];
        let dir = self.dir.path().join("received");
        let (mission, aircraft) = ("m".into(), vec!["a1".into()]);
        let admission = Admission { mission, aircraft, identity, check: Box::new(check) };
        Receiver::with_inlets(&self.settings, admission, &dir, inlets, sync_channel(1)).expect("receiver")
    }

    fn rounds(&self, receiver: &mut Receiver, n: usize) {
        for _ in 0..n {
            receiver.round(&AtomicBool::new(false)).expect("round");
            std::thread::sleep(Duration::from_millis(3));
        }
    }
}

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

/// A rogue's one byte as `a1`, numbered as high as numbers go, replaced the good model and kept every later one out.
#[test]
fn a_rogue_offer_in_an_aircrafts_name_changes_nothing_and_is_counted() {
    let b = Bench::new();
    let ids = identities(["a1", "a2"]);
    *b.fake.identity.lock().expect("lock") = ids[0].clone();
    b.publish(b.model(&noise(50_000, 20), 1, false));
    let mut r = b.receiver_of(ids[2].clone(), |_, _| Ok(()));
    b.rounds(&mut r, 1);
    assert_eq!(bytes_here(&r), noise(50_000, 20));
    // Without a signature, with another aircraft's, with the ground's own receipt key.
    for rogue in [Identity::unsigned(), ids[1].clone(), ids[2].clone()] {
        b.show_too(b.model_of(&rogue, b"x", u64::MAX, true));
    }
    b.rounds(&mut r, 2);
    assert_eq!((bytes_here(&r), r.counters.forged), (noise(50_000, 20), 6));
    assert!(!r.all_finished());
    let told: Vec<_> = r.refusals.iter().map(|(why, n)| (why.to_owned(), n)).collect();
    assert!(told.len() == 2 && told.iter().all(|(why, _)| why.contains("\"a1\"")), "{told:?}");
    // And the aircraft goes on as if nothing had been.
    b.publish(b.model(&noise(60_000, 21), 2, true));
    b.rounds(&mut r, 2);
    assert!(r.all_finished());
    assert_eq!(bytes_here(&r), noise(60_000, 21));
}

/// The first answer was taken for the answer: with one liar in the network no transfer ever ended.
#[test]
fn garbage_that_is_faster_hides_neither_offers_nor_chunks_nor_receipts() {
    let b = Bench::new();
    let ids = identities(["a1"]);
    *b.fake.identity.lock().expect("lock") = ids[0].clone();
    b.publish(b.model(&noise(50_000, 22), 1, true));
    for n in 0..200u8 {
        b.fake.offers.lock().expect("lock").insert(0, noise(usize::from(n), n));
    }
    b.fake.liars.store(2, Ordering::SeqCst);
    let mut r = b.receiver_of(ids[1].clone(), |_, _| Ok(()));
    b.rounds(&mut r, 1);
    assert!(r.all_finished() && r.all_told());
    assert_eq!(bytes_here(&r), noise(50_000, 22));
    assert_eq!((r.counters.chunks, r.counters.corrupt, r.counters.retries), (4, 8, 0));
    assert_eq!(r.counters.damaged + r.counters.forged, 200);
}

#[test]
fn a_model_that_may_not_count_leaves_the_last_good_one_and_is_told_to_its_aircraft() {
    let b = Bench::new();
    let ids = identities(["a1"]);
    *b.fake.identity.lock().expect("lock") = ids[0].clone();
    let bad = noise(20_000, 24);
    let refused = bad.clone();
    let mut r = b.receiver_of(ids[1].clone(), move |aircraft, path| {
        assert_eq!(aircraft, "a1");
        match std::fs::read(path).expect("read") == refused {
            true => Err(ModelRefusal::Meaning("it was made for mission \"other\"".into())),
            false => Ok(()),
        }
    });
    b.publish(b.model(&noise(20_000, 23), 1, false));
    b.rounds(&mut r, 1);
    let last = b.model(&bad, 2, true);
    let offer = last.offer.clone();
    b.publish(last);
    b.rounds(&mut r, 3);
    assert_eq!(bytes_here(&r), noise(20_000, 23));
    assert_eq!((r.counters.models, r.counters.models_refused), (1, 1));
    // Nothing more will come: the ground goes on with what it has.
    assert!(r.all_finished() && !r.received()[0].finished);
    let receipts = b.fake.receipts.lock().expect("lock");
    let said = Receipt::open(receipts.last().expect("one"), &ids[0], "m", "a1").and_then(|r| r.bearing(&offer));
    assert_eq!(said, Some(Delivery::Refused("it was made for mission \"other\"".into())));
}

#[test]
fn a_model_whose_reader_panics_costs_only_itself() {
    let b = Bench::new();
    b.publish(b.model(&noise(20_000, 25), 1, true));
    let mut r = b.receiver_of(Identity::unsigned(), |_, _| panic!("a bug in the reader"));
    b.rounds(&mut r, 2);
    assert!(r.received().is_empty() && r.all_finished());
    assert_eq!(r.counters.models_damaged, 1);
}

/// Ordered by the wall clock, a clock gone back hid every later model, and nobody was told.
#[test]
fn an_aircraft_whose_numbers_fell_behind_is_told_where_the_ground_is() {
    let b = Bench::new();
    let ids = identities(["a1"]);
    *b.fake.identity.lock().expect("lock") = ids[0].clone();
    b.publish(b.model(&noise(20_000, 26), 40, true));
    let mut r = b.receiver_of(ids[1].clone(), |_, _| Ok(()));
    b.rounds(&mut r, 1);
    let restarted = b.model(&noise(20_000, 27), 1, true);
    let offer = restarted.offer.clone();
    b.publish(restarted);
    b.rounds(&mut r, 2);
    assert_eq!((bytes_here(&r), r.counters.stale), (noise(20_000, 26), 2));
    let receipts = b.fake.receipts.lock().expect("lock").clone();
    assert_eq!(receipts.len(), 2, "told once");
    let said = Receipt::open(&receipts[1], &ids[0], "m", "a1").and_then(|r| r.bearing(&offer));
    assert_eq!(said, Some(Delivery::Behind(Order { flight: 1, counter: 40 })));
    b.publish(b.model(&noise(20_000, 27), 41, true));
    b.rounds(&mut r, 1);
    assert_eq!(bytes_here(&r), noise(20_000, 27));
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
    let admission = Admission { mission, aircraft, identity: Identity::unsigned(), check: Box::new(|_, _| Ok(())) };
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
    let admission = Admission { mission, aircraft, identity: Identity::unsigned(), check: Box::new(|_, _| Ok(())) };
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
