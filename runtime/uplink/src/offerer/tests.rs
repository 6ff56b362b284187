//! Both real transports, end to end, in one process.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use config::upload::Encoding;
use models::formats::model;

use super::*;
use crate::admission::Admission;
use crate::keys::Identity;
use crate::receive::Receiver;
use crate::testing::noise;
#[cfg(feature = "zenoh")]
use crate::testing::{certificates, free_port, knows_localhost};

/// Writes a model as checkpoints are written: aside, then renamed.
fn write_model(path: &Path, bytes: &[u8]) {
    let aside = path.with_extension("tmp");
    std::fs::write(&aside, bytes).expect("write");
    std::fs::rename(&aside, path).expect("rename");
}

fn receive(r: &mut Receiver, limit: Duration, mut done: impl FnMut(&Receiver) -> bool) -> bool {
    let until = Instant::now() + limit;
    while Instant::now() < until {
        r.round(&AtomicBool::new(false)).expect("round");
        if done(r) {
            return true;
        }
        r.wait();
    }
    false
}

/// A ground that takes any bytes for a model.
fn anything(ids: &[&str]) -> Admission {
    admission(ids, Identity::unsigned())
}

fn admission(ids: &[&str], identity: Identity) -> Admission {
    let aircraft = ids.iter().map(|id| (*id).to_owned()).collect();
    Admission { mission: "m".into(), aircraft, identity, check: Box::new(|_, _| Ok(())), memory: Default::default() }
}

const LIMIT: Duration = Duration::from_secs(60);

/// Settings and a model of 2,000 Gaussians for delivery through a folder.
fn delivery(dir: &Path) -> (UploadSettings, PathBuf, model::ModelHeader, models::cloud::GaussianCloud) {
    let settings = UploadSettings {
        encoding: Encoding::Delivery,
        folder: Some(dir.join("stick")),
        retry_min_s: 0.05,
        poll_s: 0.05,
        ..Default::default()
    };
    let path = dir.join("model.dgtr");
    let mut cloud = models::cloud::GaussianCloud::default();
    for i in 0..2000u32 {
        let at = |k: u32| (i * k % 997) as f32 / 50.0;
        cloud.push([at(7), at(13), at(29) / 10.0], [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[at(3) / 20.0; 3]);
    }
    let header = model::ModelHeader { aircraft: "a1".into(), ..Default::default() };
    model::write(&path, &header, &cloud).expect("write");
    (settings, path, header, cloud)
}

#[test]
fn where_no_rounded_model_can_be_written_the_exact_one_is_offered() {
    let dir = tempfile::tempdir().expect("temp dir");
    let (settings, path, ..) = delivery(dir.path());
    std::fs::create_dir(dir.path().join("model.delivery.dgtr")).expect("in the way");
    let o = Offerer::start(&settings, Source::unsigned("m", "a1")).expect("offerer");
    o.offer_final(&path);
    assert!(o.wait_delivered(LIMIT, || false));
    assert_eq!(o.status().bytes, std::fs::metadata(&path).expect("metadata").len());
}

#[test]
fn a_model_is_rounded_for_delivery_as_finely_as_is_set_and_the_ground_reads_it() {
    let sent = [Encoding::Delivery, Encoding::Fine].map(|encoding| {
        let dir = tempfile::tempdir().expect("temp dir");
        let (settings, path, header, cloud) = delivery(dir.path());
        let settings = UploadSettings { encoding, ..settings };
        let o = Offerer::start(&settings, Source::unsigned("m", "a1")).expect("offerer");
        o.offer_final(&path);
        assert!(o.wait_delivered(LIMIT, || false));
        let sent = o.status().bytes;
        assert!(10 * sent < std::fs::metadata(&path).expect("metadata").len(), "{sent} bytes");
        let left = o.status().sent;
        assert!(left > sent && left < sent + 1000, "{left} bytes left, the model and its offer");

        o.shutdown();
        let mut r = Receiver::open(&settings, anything(&["a1"]), &dir.path().join("g")).expect("receiver");
        assert!(receive(&mut r, LIMIT, |r| r.all_finished()));
        let (received, rounded) = model::read(&r.received()[0].path).expect("a model");
        assert_eq!((received, rounded.len()), (header, 2000));
        assert_eq!(model::read(&path).expect("still there").1, cloud, "training goes on from the exact one");
        sent
    });
    assert!(sent[0] < sent[1], "{sent:?} bytes");
}

#[test]
fn no_checkpoint_is_offered_that_the_last_model_replaces_before_another_could_follow() {
    let dir = tempfile::tempdir().expect("temp dir");
    let (settings, path, ..) = delivery(dir.path());
    let spacing = Duration::from_secs_f64(settings.checkpoint_s);
    for (last_in, offers) in [(spacing.mul_f64(0.9), 1), (2 * spacing, 2), (Duration::ZERO, 1)] {
        let o = Offerer::start(&settings, Source::unsigned("m", "a1")).expect("offerer");
        o.expect_last(last_in);
        o.offer(&path);
        assert_eq!(o.wait_delivered(Duration::from_secs(2), || false), offers == 2);
        o.offer_final(&path);
        assert!(o.wait_delivered(LIMIT, || false));
        assert_eq!(o.status().offers, offers);
    }
}

#[test]
fn a_checkpoint_does_not_wait_for_a_last_model_that_is_overdue() {
    let dir = tempfile::tempdir().expect("temp dir");
    let (settings, path, ..) = delivery(dir.path());
    let settings = UploadSettings { checkpoint_s: 0.5, ..settings };
    let o = Offerer::start(&settings, Source::unsigned("m", "a1")).expect("offerer");
    // It was to be here by now, and training rests.
    o.expect_last(Duration::ZERO);
    o.offer(&path);
    assert!(o.wait_delivered(LIMIT, || false));
    assert_eq!(o.status().offers, 1);
}

#[test]
fn a_model_travels_through_a_folder_that_is_plugged_in_late() {
    let dir = tempfile::tempdir().expect("temp dir");
    let stick = dir.path().join("stick");
    let settings = UploadSettings {
        folder: Some(stick.join("dgtr")),
        chunk_kib: 16,
        retry_min_s: 0.05,
        retry_max_s: 0.1,
        poll_s: 0.05,
        ..Default::default()
    };
    let path = dir.path().join("m.dgtr");
    write_model(&path, &noise(50_000, 1));
    let o = Offerer::start(&settings, Source::unsigned("m", "a1")).expect("offerer");
    o.offer_final(&path);
    assert!(!o.wait_delivered(Duration::from_millis(300), || false));
    assert!(o.status().failures > 0 && !o.status().last_error.is_empty());
    std::fs::create_dir(&stick).expect("plug in");
    assert!(o.wait_delivered(LIMIT, || false));
    o.shutdown();
    let mut r = Receiver::open(&settings, anything(&["a1"]), &dir.path().join("g")).expect("receiver");
    assert!(receive(&mut r, LIMIT, |r| r.all_finished()));
    assert_eq!(std::fs::read(&r.received()[0].path).expect("read"), noise(50_000, 1));
}

#[test]
fn without_a_way_to_the_ground_nothing_is_waited_for() {
    let o = Offerer::start(&UploadSettings::default(), Source::unsigned("m", "a1")).expect("offerer");
    o.offer_final(Path::new("/nonexistent"));
    assert!(!o.wait_delivered(LIMIT, || false));
    o.shutdown();
}

#[cfg(feature = "zenoh")]
#[test]
fn two_aircraft_deliver_over_loopback_tcp_whoever_starts_first() {
    let dir = tempfile::tempdir().expect("temp dir");
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let settings = UploadSettings {
        connect: vec![endpoint.clone()],
        listen: vec![endpoint],
        chunk_kib: 64,
        retry_min_s: 0.1,
        retry_max_s: 0.5,
        poll_s: 0.2,
        ..Default::default()
    };
    let ids = ["a1", "a2"];
    let paths = ["1.dgtr", "2.dgtr"].map(|n| dir.path().join(n));
    // The first aircraft is up before the ground, and replaces its model while it is on offer.
    let a1 = Offerer::start(&settings, Source::unsigned("m", "a1")).expect("offerer");
    write_model(&paths[0], &noise(300_000, 1));
    a1.offer(&paths[0]);
    let mut r = Receiver::open(&settings, anything(&ids), &dir.path().join("g")).expect("receiver");
    assert!(receive(&mut r, LIMIT, |r| r.received().len() == 1));
    assert!(!r.received()[0].finished);
    write_model(&paths[0], &noise(3_000_000, 2));
    a1.offer_final(&paths[0]);
    let a2 = Offerer::start(&settings, Source::unsigned("m", "a2")).expect("offerer");
    write_model(&paths[1], &noise(1_000_000, 3));
    a2.offer_final(&paths[1]);
    assert!(receive(&mut r, LIMIT, |r| r.all_finished()), "{:?} {:?}", r.counters, a1.status());
    let got: Vec<Vec<u8>> = r.received().iter().map(|m| std::fs::read(&m.path).expect("read")).collect();
    assert!(got[0] == noise(3_000_000, 2) && got[1] == noise(1_000_000, 3));
    assert!(a1.wait_delivered(LIMIT, || false) && a2.wait_delivered(LIMIT, || false));
    assert_eq!(r.counters.corrupt, 0);
    a1.shutdown();
    a2.shutdown();
}

#[cfg(feature = "zenoh")]
#[test]
fn a_ground_station_that_restarts_mid_transfer_resumes_over_the_network() {
    let dir = tempfile::tempdir().expect("temp dir");
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let settings = UploadSettings {
        connect: vec![endpoint.clone()],
        listen: vec![endpoint],
        chunk_kib: 16,
        retry_min_s: 0.1,
        retry_max_s: 0.5,
        poll_s: 0.02,
        ..Default::default()
    };
    let path = dir.path().join("m.dgtr");
    write_model(&path, &noise(8_000_000, 4));
    let o = Offerer::start(&settings, Source::unsigned("m", "a1")).expect("offerer");
    o.offer_final(&path);
    let ids = ["a1"];
    let mut r = Receiver::open(&settings, anything(&ids), &dir.path().join("g")).expect("receiver");
    assert!(receive(&mut r, LIMIT, |r| r.counters.chunks > 0));
    let first = r.counters.chunks;
    assert!(!r.all_finished());
    drop(r);
    let mut r = Receiver::open(&settings, anything(&ids), &dir.path().join("g")).expect("receiver");
    assert!(receive(&mut r, LIMIT, |r| r.all_finished()));
    assert_eq!(r.counters.chunks_reused, first);
    assert_eq!(r.counters.chunks + first, 489);
    assert!(o.wait_delivered(LIMIT, || false));
    assert!(std::fs::read(&r.received()[0].path).expect("read") == noise(8_000_000, 4));
}

#[cfg(feature = "zenoh")]
#[test]
fn over_tls_only_aircraft_of_the_same_authority_deliver() {
    if !knows_localhost() {
        return;
    }
    let dir = tempfile::tempdir().expect("temp dir");
    let endpoint = format!("tls/localhost:{}", free_port());
    let ours = dir.path().join("ours");
    let ground = UploadSettings {
        listen: vec![endpoint.clone()],
        tls: Some(certificates(&ours, "ground")),
        chunk_kib: 64,
        poll_s: 0.2,
        ..Default::default()
    };
    let aircraft = |tls| UploadSettings {
        connect: vec![endpoint.clone()],
        listen: vec![],
        tls: Some(tls),
        retry_min_s: 0.1,
        retry_max_s: 0.5,
        ..ground.clone()
    };
    let path = dir.path().join("m.dgtr");
    write_model(&path, &noise(500_000, 5));
    let ids = ["friend", "stranger"];
    let mut r = Receiver::open(&ground, anything(&ids), &dir.path().join("g")).expect("receiver");
    let stranger = aircraft(certificates(&dir.path().join("theirs"), "stranger"));
    let stranger = Offerer::start(&stranger, Source::unsigned("m", "stranger")).expect("offerer");
    stranger.offer_final(&path);
    let friend = Offerer::start(&aircraft(certificates(&ours, "friend")), Source::unsigned("m", "friend"));
    let friend = friend.expect("offerer");
    friend.offer_final(&path);
    assert!(receive(&mut r, LIMIT, |r| !r.received().is_empty()), "{:?}", friend.status());
    assert!(friend.wait_delivered(LIMIT, || false));
    assert!(!receive(&mut r, Duration::from_secs(2), |r| r.received().len() > 1));
    assert!(r.received()[0].aircraft == "friend" && !stranger.status().delivered);
}

/// A stick that nobody cleared ended the next day's reception with yesterday's model.
#[test]
fn yesterdays_final_model_on_the_stick_is_named_and_not_taken_for_todays() {
    let dir = tempfile::tempdir().expect("temp dir");
    let ids = crate::keys::testing::identities(["a1"]);
    let settings = UploadSettings {
        folder: Some(dir.path().join("stick")),
        retry_min_s: 0.05,
        poll_s: 0.05,
        ..Default::default()
    };
    let numbers = dir.path().join("a1.flight");
    let fly = |seed: u8| {
        let path = dir.path().join("m.dgtr");
        std::fs::write(&path, noise(100_000, seed)).expect("write");
        let source =
            Source { identity: ids[0].clone(), flight_number: Some(numbers.clone()), ..Source::unsigned("m", "a1") };
        let o = Offerer::start(&settings, source).expect("offerer");
        o.offer_final(&path);
        assert!(o.wait_delivered(LIMIT, || false));
    };
    let session = |name: &str, again: bool| {
        let received = dir.path().join(name);
        let memory =
            crate::memory::Memory::open(&dir.path().join("state"), "m", &received, None, again).expect("memory");
        Receiver::open(&settings, Admission { memory, ..admission(&["a1"], ids[1].clone()) }, &received)
            .expect("receiver")
    };
    fly(1);
    let mut yesterday = session("yesterday", false);
    assert!(receive(&mut yesterday, LIMIT, |r| r.all_finished()));
    // The same session goes on after a restart.
    drop(yesterday);
    assert!(receive(&mut session("yesterday", false), LIMIT, |r| r.all_finished()));
    let mut today = session("today", false);
    assert!(!receive(&mut today, Duration::from_secs(1), |r| r.all_finished()), "yesterday's was taken");
    assert!(today.received().is_empty() && today.counters.stale > 0, "{:?}", today.counters);
    let why: Vec<String> = today.refusals.iter().map(|(why, _)| why.to_owned()).collect();
    assert!(why.len() == 1 && why[0].contains("a1's final model of flight 1"), "{why:?}");
    fly(2);
    assert!(receive(&mut today, LIMIT, |r| r.all_finished()), "{:?}", today.counters);
    assert!(std::fs::read(&today.received()[0].path).expect("read") == noise(100_000, 2));
    assert!(receive(&mut session("once more", true), LIMIT, |r| r.all_finished()), "asked for");
}

/// An aircraft whose number file was lost begins with flight 1; the receipt tells it how far its ground has come.
#[test]
fn an_aircraft_whose_numbers_fell_behind_an_earlier_session_is_told_and_goes_on_beyond() {
    let dir = tempfile::tempdir().expect("temp dir");
    let ids = crate::keys::testing::identities(["a1"]);
    let settings = UploadSettings {
        folder: Some(dir.path().join("stick")),
        retry_min_s: 0.05,
        poll_s: 0.05,
        ..Default::default()
    };
    for (day, seed) in [("first", 1), ("second", 2)] {
        let received = dir.path().join(day);
        let memory =
            crate::memory::Memory::open(&dir.path().join("state"), "m", &received, None, false).expect("memory");
        let admission = Admission { memory, ..admission(&["a1"], ids[1].clone()) };
        let mut r = Receiver::open(&settings, admission, &received).expect("receiver");
        let path = dir.path().join("m.dgtr");
        std::fs::write(&path, noise(100_000, seed)).expect("write");
        let source = Source { identity: ids[0].clone(), ..Source::unsigned("m", "a1") };
        // The ground is there first, and sees what the day before left on the stick.
        receive(&mut r, Duration::from_millis(500), |_| false);
        let o = Offerer::start(&settings, source).expect("offerer");
        o.offer_final(&path);
        assert!(receive(&mut r, LIMIT, |r| r.all_finished()), "{day}: {:?}", r.counters);
        assert!(std::fs::read(&r.received()[0].path).expect("read") == noise(100_000, seed));
    }
}

/// Another computer at the ground has no memory; what an offer was made for is in the offer.
#[test]
fn a_model_made_for_another_session_is_refused_by_a_ground_that_remembers_nothing() {
    let dir = tempfile::tempdir().expect("temp dir");
    let ids = crate::keys::testing::identities(["a1"]);
    let settings = UploadSettings {
        folder: Some(dir.path().join("stick")),
        retry_min_s: 0.05,
        poll_s: 0.05,
        ..Default::default()
    };
    let fly = |seed: u8| {
        let path = dir.path().join("m.dgtr");
        std::fs::write(&path, noise(100_000, seed)).expect("write");
        let numbers = Some(dir.path().join("a1.flight"));
        let source = Source { identity: ids[0].clone(), flight_number: numbers, ..Source::unsigned("m", "a1") };
        let o = Offerer::start(&settings, source).expect("offerer");
        o.offer_final(&path);
        assert!(o.wait_delivered(LIMIT, || false));
    };
    let session = |computer: &str| {
        let (state, received) = (dir.path().join(format!("state of {computer}")), dir.path().join(computer));
        std::fs::create_dir_all(&state).expect("made");
        let memory = crate::memory::Memory::open(&state, "m", &received, None, false).expect("memory");
        let admission = Admission { memory, ..admission(&["a1"], ids[1].clone()) };
        Receiver::open(&settings, admission, &received).expect("receiver")
    };
    // The stick is in the ground's computer before the flight.
    let mut yesterday = session("yesterday's");
    assert!(
        !receive(&mut yesterday, Duration::ZERO, |_| false)
            && !yesterday.round(&AtomicBool::new(false)).expect("round")
    );
    fly(1);
    assert!(receive(&mut yesterday, LIMIT, |r| r.all_finished()) && yesterday.received()[0].bound);
    let mut today = session("today's");
    assert!(!receive(&mut today, Duration::from_secs(1), |r| r.all_finished()), "yesterday's was taken");
    let [(id, why)] = &today.stale()[..] else { panic!("{:?}", today.stale()) };
    assert!(id == "a1" && why.contains("a1's final model of flight 1 is not of this session"), "{why}");
    fly(2);
    assert!(receive(&mut today, LIMIT, |r| r.all_finished()), "{:?}", today.counters);
    assert!(std::fs::read(&today.received()[0].path).expect("read") == noise(100_000, 2));
    assert!(today.received()[0].bound && today.stale().is_empty());
    // Between two sessions the stick names none.
    today.end_session();
    assert!(!dir.path().join("stick/m/ground.session").exists());
}
