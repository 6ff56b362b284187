//! Strangers on the network: whoever speaks in another's name, and whoever answers faster than the one who was asked.

use std::io::{Read, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use super::*;
use crate::admission::Admission;
use crate::binding;
use crate::heartbeat::{Condition, EVERY};
use crate::keys::testing::identities;
use crate::keys::{Domain, Identity};
use crate::memory::Memory;
use crate::offer::{OfferedModel, Order};
use crate::receipt::{Receipt, Verdict};
use crate::receive::Receiver;
use crate::testing::{certificates, free_port, knows_localhost, noise};
use crate::{Offerer, Source};

const LIMIT: Duration = Duration::from_secs(60);

fn settings(endpoint: &str) -> UploadSettings {
    UploadSettings {
        connect: vec![endpoint.to_owned()],
        listen: vec![endpoint.to_owned()],
        chunk_kib: 64,
        retry_min_s: 0.1,
        retry_max_s: 0.5,
        poll_s: 0.2,
        ..Default::default()
    }
}

fn source(aircraft: &str, identity: &Identity) -> Source {
    Source { identity: identity.clone(), ..Source::unsigned("m", aircraft) }
}

fn ground(settings: &UploadSettings, ids: &[&str], identity: &Identity, dir: &Path) -> Receiver {
    let aircraft = ids.iter().map(|id| (*id).to_owned()).collect();
    let check = Box::new(|_: &str, _: &Path| Ok(()));
    let admission =
        Admission { mission: "m".into(), aircraft, identity: identity.clone(), check, memory: Default::default() };
    Receiver::open(settings, admission, dir).expect("receiver")
}

fn receive(r: &mut Receiver, limit: Duration, mut done: impl FnMut(&Receiver) -> bool) -> bool {
    let until = Instant::now() + limit;
    while Instant::now() < until {
        r.round(&AtomicBool::new(false)).expect("round");
        if done(r) {
            return true;
        }
    }
    false
}

/// Anybody could say "have" for the ground, and `fly` stopped waiting for its model to be safe.
#[test]
fn a_false_receipt_over_the_network_is_not_believed() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = settings(&format!("tcp/127.0.0.1:{}", free_port()));
    let ids = identities(["a1", "a2"]);
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, noise(100_000, 1)).expect("write");
    // Where the ground should be sits somebody else.
    let stranger = open(&settings, &settings.listen, &[], ("stranger", &Identity::unsigned()), None).expect("session");
    let o = Offerer::start(&settings, source("a1", &ids[0])).expect("offerer");
    o.offer_final(&path);
    let order = Order { flight: 1, counter: 1 };
    let offer = OfferedModel::open(&path, &settings, &source("a1", &ids[0]), order, true).expect("offer").offer;
    let receipt = Receipt::new(&offer, Verdict::Received);
    let say = |bytes: Vec<u8>| {
        let asked = stranger.get("dgtr/m/a1/receipt").payload(bytes).timeout(Duration::from_secs(2)).wait();
        asked.expect("asked").into_iter().count()
    };
    let until = Instant::now() + LIMIT;
    let asks = |who: &Identity| {
        let key = "dgtr/m/a1/offer";
        let question = binding::seal(&[3; 32], key, Domain::Request, who);
        stranger.get(key).payload(question).timeout(LOOK_UP * 5).wait().expect("asked").into_iter().count()
    };
    while asks(&ids[2]) == 0 {
        assert!(Instant::now() < until, "no connection");
        std::thread::sleep(LOOK_UP);
    }
    for forger in [Identity::unsigned(), ids[0].clone(), ids[1].clone()] {
        assert_eq!(say(receipt.seal(&forger)), 0, "signed for");
    }
    assert!(!o.wait_delivered(Duration::from_secs(1), || false));
    // Nor does anybody but the ground get a model, or as much as an offer.
    for other in [Identity::unsigned(), ids[0].clone(), ids[1].clone()] {
        assert_eq!(asks(&other), 0, "answered");
    }
    // The ground's own is.
    assert_eq!(say(receipt.seal(&ids[2])), 1);
    assert!(o.wait_delivered(LIMIT, || false));
}

/// Before its first model, and after its last sign of life, nobody knew how an aircraft was.
#[test]
fn the_ground_hears_how_an_aircraft_is_from_itself_alone_and_knows_for_how_long_it_has_not() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = settings(&format!("tcp/127.0.0.1:{}", free_port()));
    let ids = identities(["a1", "a2"]);
    let mut r = ground(&settings, &["a1", "a2"], &ids[2], &dir.path().join("g"));
    let a1 = Offerer::start(&settings, source("a1", &ids[0])).expect("offerer");
    // Somebody says it in the name of another.
    let rogue = Offerer::start(&settings, source("a2", &ids[0])).expect("offerer");
    let low = Condition { battery_pct: Some(14), battery_low: true, ..Condition::default() };
    [&a1, &rogue].into_iter().for_each(|aircraft| aircraft.say(low));
    assert!(receive(&mut r, LIMIT, |r| r.last_heard()[0].condition == Some(low)), "{:?}", r.last_heard());
    drop(a1);
    assert!(
        receive(&mut r, LIMIT, |r| r.last_heard()[0].ago.is_some_and(|ago| ago > 4 * EVERY)),
        "{:?}",
        r.last_heard()
    );
    assert!(r.last_heard()[1].ago.is_none() && r.last_heard()[1].condition.is_none(), "{:?}", r.last_heard());
    drop(rogue);
}

/// The first answer was taken for the answer, so that one liar could hide an aircraft for ever.
#[test]
fn a_liar_on_the_network_hides_nobody_and_gets_nothing_in() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = settings(&format!("tcp/127.0.0.1:{}", free_port()));
    let ids = identities(["a1", "a2"]);
    let mut r = ground(&settings, &["a1"], &ids[2], &dir.path().join("g"));
    // One answers with garbage, one with an offer that a2 signed in the name of a1.
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, b"x").expect("write");
    let order = Order { flight: u64::MAX, counter: u64::MAX };
    let rogue = OfferedModel::open(&path, &settings, &source("a1", &ids[1]), order, true).expect("offer").offer;
    let liars = [vec![7; 64], rogue.encode()].map(|answer| open_client(&settings, "dgtr/m/a1/**", answer));
    std::fs::write(&path, noise(500_000, 2)).expect("write");
    assert!(receive(&mut r, LIMIT, |r| r.counters.forged > 0 && r.counters.damaged > 0));
    let a1 = Offerer::start(&settings, source("a1", &ids[0])).expect("offerer");
    a1.offer_final(&path);
    assert!(receive(&mut r, LIMIT, |r| r.all_finished() && r.all_told()), "{:?} {:?}", r.counters, a1.status());
    assert!(a1.wait_delivered(LIMIT, || false));
    assert!(std::fs::read(&r.received()[0].path).expect("read") == noise(500_000, 2));
    assert_eq!((r.counters.chunks, r.counters.models), (8, 1));
    drop(liars);
}

/// A certificate of one aircraft was good for the names of all.
#[test]
fn over_tls_an_aircrafts_certificate_speaks_under_its_own_name_only() {
    if !knows_localhost() {
        return;
    }
    let dir = tempfile::tempdir().expect("temp dir");
    let endpoint = format!("tls/localhost:{}", free_port());
    let with = |name: &str| {
        let tls = Some(certificates(&dir.path().join("tls"), name));
        UploadSettings { tls, ..settings(&endpoint) }
    };
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, noise(100_000, 3)).expect("write");
    // Without keys, so that nothing but the certificate protects the name.
    let nobody = Identity::unsigned();
    let mut r = ground(&with("ground"), &["a1", "a2"], &nobody, &dir.path().join("g"));
    let a2 = with("a2");
    let rogue = Offerer::start(&a2, source("a1", &nobody)).expect("offerer");
    rogue.offer_final(&path);
    let honest = Offerer::start(&a2, source("a2", &nobody)).expect("offerer");
    honest.offer_final(&path);
    assert!(receive(&mut r, LIMIT, |r| !r.received().is_empty() && r.all_told()), "{:?}", honest.status());
    assert!(!receive(&mut r, Duration::from_secs(3), |r| r.received().len() > 1));
    assert_eq!(r.received()[0].aircraft, "a2");
    assert!(honest.wait_delivered(LIMIT, || false) && !rogue.status().delivered);
}

/// A client of the ground's own endpoint asked the aircraft by way of it, and took the link from the ground.
#[test]
fn the_ground_passes_on_nothing_between_those_who_connect_to_it() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = settings(&format!("tcp/127.0.0.1:{}", free_port()));
    let mut r = ground(&settings, &["a1"], &Identity::unsigned(), &dir.path().join("g"));
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, noise(100_000, 3)).expect("write");
    let a1 = Offerer::start(&settings, source("a1", &Identity::unsigned())).expect("offerer");
    a1.offer(&path);
    assert!(receive(&mut r, LIMIT, |r| r.counters.models == 1), "{:?}", r.counters);
    let endpoint = serde_json::json!({
        "mode": "client", "connect": { "endpoints": settings.connect }, "scouting": { "multicast": { "enabled": false } },
    });
    let client =
        zenoh::open(zenoh::Config::from_json5(&endpoint.to_string()).expect("settings")).wait().expect("session");
    let overheard = client.declare_subscriber("**").wait().expect("subscriber");
    let asked = client.get("dgtr/m/a1/offer").timeout(Duration::from_secs(2)).wait().expect("asked");
    assert_eq!(asked.into_iter().filter(|reply| reply.result().is_ok()).count(), 0, "the aircraft answered a stranger");
    a1.offer_final(&path);
    assert!(receive(&mut r, LIMIT, |r| r.all_finished()), "{:?}", r.counters);
    assert_eq!(overheard.drain().count(), 0);
}

/// 130 connections that said nothing took every place of those who want in.
#[test]
fn connections_that_say_nothing_keep_no_aircraft_out() {
    let dir = tempfile::tempdir().expect("temp dir");
    let port = free_port();
    let settings = settings(&format!("tcp/127.0.0.1:{port}"));
    let mut r = ground(&settings, &["a1"], &Identity::unsigned(), &dir.path().join("g"));
    let idle = || {
        let stream = std::net::TcpStream::connect(("127.0.0.1", port)).expect("listening");
        stream.set_nonblocking(true).expect("its own");
        stream
    };
    let mut all: Vec<_> = (0..200).map(|_| idle()).collect();
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, noise(100_000, 4)).expect("write");
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // Whoever is sent away comes again.
            while !is_over.load(Ordering::Relaxed) {
                for stream in &mut all {
                    if !matches!(stream.read(&mut [0]), Err(e) if e.kind() == std::io::ErrorKind::WouldBlock) {
                        *stream = idle();
                    }
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        let a1 = Offerer::start(&settings, source("a1", &Identity::unsigned())).expect("offerer");
        a1.offer_final(&path);
        let is_here = receive(&mut r, LIMIT, |r| r.all_finished());
        is_over.store(true, Ordering::Relaxed);
        assert!(is_here, "{:?}", r.counters);
    });
}

/// Every handshake that failed held up all others for a tenth of a second: whoever begins ten a second kept everybody out.
#[test]
fn strangers_whose_handshakes_fail_by_the_dozen_keep_no_aircraft_out() {
    let dir = tempfile::tempdir().expect("temp dir");
    let port = free_port();
    let settings = settings(&format!("tls/127.0.0.1:{port}"));
    let ids = identities(["a1"]);
    let mut r = ground(&settings, &["a1"], &ids[1], &dir.path().join("g"));
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, noise(100_000, 8)).expect("write");
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // The oldest are let go, as their descriptors are this process's.
            let mut strangers = std::collections::VecDeque::new();
            while !is_over.load(Ordering::Relaxed) {
                let stranger = std::net::TcpStream::connect(("127.0.0.1", port));
                strangers.extend(stranger.and_then(|mut s| s.write_all(b"no handshake").map(|()| s)));
                strangers.drain(..strangers.len().saturating_sub(50));
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        // They are there first.
        receive(&mut r, Duration::from_secs(2), |_| false);
        let a1 = Offerer::start(&settings, source("a1", &ids[0])).expect("offerer");
        a1.offer_final(&path);
        let is_here = receive(&mut r, LIMIT, |r| r.all_finished() && r.all_told());
        is_over.store(true, Ordering::Relaxed);
        assert!(is_here, "{:?} {:?}", r.counters, a1.status());
    });
}

/// Off this machine encryption is the default, and nobody has to make, sign or copy certificates for it.
#[test]
fn the_keys_of_the_mission_are_all_that_tls_needs_and_keep_strangers_out() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = settings(&format!("tls/127.0.0.1:{}", free_port()));
    // In the second the name a1 has another key.
    let (ids, others) = (identities(["a1", "a2"]), identities(["a0", "a1"]));
    let mut r = ground(&settings, &["a1", "a2"], &ids[2], &dir.path().join("g"));
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, noise(100_000, 5)).expect("write");
    let stranger = Offerer::start(&settings, source("a1", &others[1])).expect("offerer");
    stranger.offer_final(&path);
    assert!(
        !receive(&mut r, Duration::from_secs(3), |r| r.counters.forged + r.counters.models > 0),
        "a stranger got in"
    );
    let a1 = Offerer::start(&settings, source("a1", &ids[0])).expect("offerer");
    let a2 = Offerer::start(&settings, source("a2", &ids[1])).expect("offerer");
    a1.offer_final(&path);
    a2.offer_final(&path);
    assert!(receive(&mut r, LIMIT, |r| r.all_finished() && r.all_told()), "{:?}", r.counters);
    assert!(!stranger.status().delivered);
}

/// Whoever kept yesterday's answer gives it today, to a ground that remembers nothing.
#[test]
fn an_answer_kept_from_another_session_is_refused_and_todays_is_bound_to_todays() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = settings(&format!("tcp/127.0.0.1:{}", free_port()));
    let ids = identities(["a1"]);
    let memory = |day: &str| Memory::open(dir.path(), "m", &dir.path().join(day), None, false).expect("memory");
    let admission = |memory| Admission {
        mission: "m".into(),
        aircraft: vec!["a1".into()],
        identity: ids[1].clone(),
        check: Box::new(|_, _| Ok(())),
        memory,
    };
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, noise(100_000, 6)).expect("write");
    let order = Order { flight: u64::MAX, counter: 1 };
    let old = OfferedModel::open(&path, &settings, &source("a1", &ids[0]), order, true).expect("offer").offer;
    let kept = old.bound_to(memory("yesterday").session(), &ids[0]).encode();
    let mut r = Receiver::open(&settings, admission(memory("today")), &dir.path().join("today")).expect("receiver");
    let replay = open_client(&settings, "dgtr/m/a1/**", kept);
    assert!(receive(&mut r, LIMIT, |r| !r.stale().is_empty()), "{:?}", r.counters);
    assert!(r.received().is_empty() && r.stale()[0].1.contains("it was made for another one"), "{:?}", r.stale());
    std::fs::write(&path, noise(100_000, 7)).expect("write");
    let a1 = Offerer::start(&settings, source("a1", &ids[0])).expect("offerer");
    a1.offer_final(&path);
    assert!(receive(&mut r, LIMIT, |r| r.all_finished()), "{:?} {:?}", r.counters, a1.status());
    assert!(std::fs::read(&r.received()[0].path).expect("read") == noise(100_000, 7) && r.received()[0].bound);
    drop(replay);
}
