//! Promises over links that carry little, counted in bytes on the wire.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use config::upload::UploadSettings;

use super::admission::Admission;
use super::receive::Receiver;
use super::testing::{Proxy, Weather, free_port, noise};
use super::{Offerer, Source};
use crate::keys::Identity;

const LIMIT: Duration = Duration::from_secs(120);
const MODEL: usize = 300_000;

struct Flight {
    dir: tempfile::TempDir,
    proxy: Proxy,
    aircraft: UploadSettings,
    ground: UploadSettings,
}

impl Flight {
    /// A link of `rate` bytes per second.
    fn new(rate: f64, settings: UploadSettings) -> Self {
        let port = free_port();
        let weather = Weather { rate, delay: Duration::from_millis(5), loss_pct: 0, seed: 1 };
        let proxy = Proxy::to(port, weather);
        let settings = UploadSettings {
            chunk_kib: 16,
            retry_min_s: 0.1,
            retry_max_s: 0.5,
            poll_s: 0.5,
            listen: vec![format!("tcp/127.0.0.1:{port}")],
            connect: vec![format!("tcp/127.0.0.1:{}", proxy.port)],
            ..settings
        };
        let aircraft = UploadSettings { listen: vec![], ..settings.clone() };
        Self { dir: tempfile::tempdir().expect("temp dir"), proxy, aircraft, ground: settings }
    }

    fn receiver(&self) -> Receiver {
        let check = Box::new(|_: &str, _: &Path| Ok(()));
        let (mission, aircraft) = ("m".into(), vec!["a1".into()]);
        let admission =
            Admission { mission, aircraft, identity: Identity::unsigned(), check, memory: Default::default() };
        Receiver::open(&self.ground, admission, &self.dir.path().join("g")).expect("receiver")
    }

    fn save(&self, seed: u8) -> std::path::PathBuf {
        let path = self.dir.path().join("m.dgtr");
        std::fs::write(path.with_extension("tmp"), noise(MODEL, seed)).expect("write");
        std::fs::rename(path.with_extension("tmp"), &path).expect("rename");
        path
    }

    /// Saves and offers `checkpoints` models `every` so often, then the last one; returns what the ground counted.
    fn fly(&self, checkpoints: u8, every: Duration) -> (Receiver, Offerer) {
        let mut r = self.receiver();
        let o = Offerer::start(&self.aircraft, Source::unsigned("m", "a1")).expect("offerer");
        let stop = AtomicBool::new(false);
        for n in 0..checkpoints {
            o.offer(&self.save(n));
            let until = Instant::now() + every;
            while Instant::now() < until {
                r.round(&stop).expect("round");
            }
        }
        o.offer_final(&self.save(checkpoints));
        let until = Instant::now() + LIMIT;
        while !(r.all_finished() && r.all_told()) && Instant::now() < until {
            r.round(&stop).expect("round");
        }
        assert!(std::fs::read(&r.received()[0].path).expect("read") == noise(MODEL, checkpoints));
        assert!(o.wait_delivered(LIMIT, || false));
        (r, o)
    }
}

/// Each newer checkpoint evicted the one that was being fetched: 40 checkpoints of 4.8 intervals' transfer each, 7 MiB
/// sent, and nothing delivered.
#[test]
fn checkpoints_arrive_over_a_link_that_needs_five_intervals_for_each() {
    let every = Duration::from_millis(500);
    let rate = MODEL as f64 / (4.8 * every.as_secs_f64());
    let flight = Flight::new(rate, UploadSettings { checkpoint_s: every.as_secs_f64(), ..Default::default() });
    let (r, o) = flight.fly(20, every);
    // Checkpoints took their share of the link, the last one's chunks were not fetched twice.
    let delivered = r.counters.models - 1;
    println!("{delivered} checkpoints delivered, {} offered, {} bytes sent", o.status().offers, flight.proxy.sent());
    assert!(delivered >= 1, "{:?}", r.counters);
    assert!(flight.proxy.sent() < (r.counters.models + 2) * MODEL as u64 * 13 / 10);
}

#[test]
fn when_only_the_last_model_counts_nothing_else_is_sent() {
    let every = Duration::from_millis(200);
    let flight = Flight::new(200e3, UploadSettings { checkpoint_s: 0.0, ..Default::default() });
    let (r, _) = flight.fly(10, every);
    let share = flight.proxy.sent() as f64 / MODEL as f64;
    println!("{share:.3} × the final model sent");
    assert!(share <= 1.3 && r.counters.models == 1, "{share}");
}

#[test]
fn an_aircraft_keeps_to_its_share_of_the_link() {
    let settings = UploadSettings { max_kib_s: Some(100), checkpoint_s: 0.0, ..Default::default() };
    let flight = Flight::new(50e6, settings);
    let start = Instant::now();
    flight.fly(0, Duration::ZERO);
    // The first chunk leaves at once.
    let least = (MODEL - (16 << 10)) as f64 / (100.0 * 1024.0);
    assert!(start.elapsed().as_secs_f64() > 0.95 * least, "{:?}", start.elapsed());
}
