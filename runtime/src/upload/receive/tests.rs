//! Promises of the ground's side, against an aircraft in memory that misbehaves on demand.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use super::*;
use crate::upload::offer::{Hash, OfferedModel};
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
    asked: Mutex<Vec<usize>>,
    confirmed: Mutex<Vec<Hash>>,
}

fn take(n: &AtomicU32) -> bool {
    n.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |v| v.checked_sub(1)).is_ok()
}

impl Inlet for Arc<Fake> {
    fn name(&self) -> String {
        "fake".into()
    }

    fn offers(&self) -> Result<Vec<Vec<u8>>, TransportError> {
        Ok(self.offers.lock().expect("lock").clone())
    }

    fn chunk(&self, offer: &Offer, index: usize) -> Result<Vec<u8>, TransportError> {
        if take(&self.withhold) || !take(&self.quota) {
            return Err(TransportError::Network("out of range".into()));
        }
        let models = self.models.lock().expect("lock");
        let model = models.iter().find(|m| m.offer.model == offer.model);
        let model = model.ok_or(TransportError::NotHeld(offer.chunks[index]))?;
        self.asked.lock().expect("lock").push(index);
        let mut bytes = model.chunk(index).expect("chunk");
        if take(&self.corrupt) {
            bytes[0] ^= 1;
        }
        Ok(bytes)
    }

    fn confirm(&self, offer: &Offer) -> Result<(), TransportError> {
        self.confirmed.lock().expect("lock").push(offer.model);
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

    fn model(&self, bytes: &[u8], sequence: u64, finished: bool) -> OfferedModel {
        let path = self.dir.path().join("source.dgtr");
        std::fs::remove_file(&path).ok();
        std::fs::write(&path, bytes).expect("write");
        OfferedModel::open(&path, &self.settings, ("m", "a1"), sequence, finished).expect("model")
    }

    fn publish(&self, model: OfferedModel) {
        *self.fake.offers.lock().expect("lock") = vec![model.offer.encode()];
        self.fake.models.lock().expect("lock").push(model);
    }

    fn receiver(&self) -> Receiver {
        let inlets: Vec<Box<dyn Inlet>> = vec![Box::new(self.fake.clone())];
        let dir = self.dir.path().join("received");
        Receiver::with_inlets(&self.settings, "m", &["a1".into()], &dir, inlets, sync_channel(1)).expect("receiver")
    }

    fn rounds(&self, receiver: &mut Receiver, n: usize) {
        for _ in 0..n {
            receiver.round(&AtomicBool::new(false)).expect("round");
            std::thread::sleep(Duration::from_millis(3));
        }
    }
}

fn noise(n: usize, seed: u8) -> Vec<u8> {
    let mut bytes = vec![0; n];
    blake3::Hasher::new_keyed(&[seed; 32]).finalize_xof().fill(&mut bytes);
    bytes
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
    assert_eq!(b.fake.confirmed.lock().expect("lock").len(), 1);
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
        OfferedModel::open(&path, &wide, (mission, aircraft), 1, true).expect("model").offer.encode()
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
    assert_eq!(b.fake.confirmed.lock().expect("lock").len(), 2);
}
