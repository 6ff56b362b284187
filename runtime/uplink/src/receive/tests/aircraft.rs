//! An aircraft in memory that misbehaves on demand, and a ground station beside it.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use super::*;

#[derive(Default)]
pub(super) struct Fake {
    pub(super) offers: Mutex<Vec<Vec<u8>>>,
    pub(super) models: Mutex<Vec<OfferedModel>>,
    /// Chunk replies to spoil or withhold before behaving.
    pub(super) corrupt: AtomicU32,
    pub(super) withhold: AtomicU32,
    /// Serve at most this many chunks, then act as if out of range.
    pub(super) quota: AtomicU32,
    /// How many answer every question with garbage before the aircraft does.
    pub(super) liars: AtomicU32,
    pub(super) asked: Mutex<Vec<usize>>,
    pub(super) receipts: Mutex<Vec<Vec<u8>>>,
    /// Receipts to lose.
    pub(super) deaf: AtomicU32,
    /// The aircraft's.
    pub(super) identity: Mutex<Identity>,
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
        if take(&self.deaf) {
            return Err(TransportError::Network("the aircraft did not take the receipt".into()));
        }
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

pub(super) struct Bench {
    pub(super) dir: tempfile::TempDir,
    pub(super) fake: Arc<Fake>,
    pub(super) settings: UploadSettings,
}

impl Bench {
    pub(super) fn new() -> Self {
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

    pub(super) fn model(&self, bytes: &[u8], counter: u64, finished: bool) -> OfferedModel {
        self.model_of(&self.fake.identity.lock().expect("lock").clone(), bytes, counter, finished)
    }

    pub(super) fn model_of(&self, identity: &Identity, bytes: &[u8], counter: u64, finished: bool) -> OfferedModel {
        let path = self.dir.path().join("source.dgtr");
        std::fs::remove_file(&path).ok();
        std::fs::write(&path, bytes).expect("write");
        let source = Source { identity: identity.clone(), ..Source::unsigned("m", "a1") };
        OfferedModel::open(&path, &self.settings, &source, Order { flight: 1, counter }, finished).expect("model")
    }

    pub(super) fn show_too(&self, model: OfferedModel) {
        self.fake.offers.lock().expect("lock").insert(0, model.offer.encode());
        self.fake.models.lock().expect("lock").push(model);
    }

    pub(super) fn publish(&self, model: OfferedModel) {
        *self.fake.offers.lock().expect("lock") = vec![model.offer.encode()];
        self.fake.models.lock().expect("lock").push(model);
    }

    pub(super) fn receiver(&self) -> Receiver {
        self.receiver_of(Identity::unsigned(), |_, _| Ok(()))
    }

    pub(super) fn receiver_of(
        &self,
        identity: Identity,
        check: impl Fn(&str, &Path) -> Result<(), ModelRefusal> + Send + Sync + 'static,
    ) -> Receiver {
        let inlets: Vec<Box<dyn Inlet>> = vec![Box::new(self.fake.clone())];
        let dir = self.dir.path().join("received");
        let (mission, aircraft) = ("m".into(), vec!["a1".into()]);
        let admission = Admission { mission, aircraft, identity, check: Box::new(check), memory: Default::default() };
        Receiver::with_inlets(&self.settings, admission, &dir, inlets, sync_channel(1)).expect("receiver")
    }

    pub(super) fn rounds(&self, receiver: &mut Receiver, n: usize) {
        for _ in 0..n {
            receiver.round(&AtomicBool::new(false)).expect("round");
            std::thread::sleep(Duration::from_millis(3));
        }
    }
}
