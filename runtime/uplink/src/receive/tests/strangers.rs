//! Promises about those who are not who they say they are, and models that may not count.

use super::*;

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
    assert_eq!(b.fake.receipts.lock().expect("lock").len(), 1, "the aircraft itself has it");
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
    let mut b = Bench::new();
    b.settings.retry_max_s = 3600.0;
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

/// It was said once. An aircraft that did not hear it, or that a full disk let begin with the same number again, waited for ever.
#[test]
fn that_its_numbers_fell_behind_is_said_again_while_an_aircraft_shows_the_same_offer() {
    let b = Bench::new();
    let ids = identities(["a1"]);
    *b.fake.identity.lock().expect("lock") = ids[0].clone();
    b.publish(b.model(&noise(20_000, 28), 40, true));
    let mut r = b.receiver_of(ids[1].clone(), |_, _| Ok(()));
    b.rounds(&mut r, 1);
    b.fake.receipts.lock().expect("lock").clear();
    b.fake.deaf.store(2, Ordering::SeqCst);
    b.publish(b.model(&noise(20_000, 29), 1, true));
    b.rounds(&mut r, 20);
    let receipts = b.fake.receipts.lock().expect("lock").len();
    assert!(b.fake.deaf.load(Ordering::SeqCst) == 0 && receipts > 1, "heard {receipts} times");
    assert_eq!(r.counters.retries, 2, "what was lost is counted");
}
