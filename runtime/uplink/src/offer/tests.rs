//! Promises of offers.

use super::*;

#[test]
fn the_page_on_formats_states_this_version() {
    let row = format!(
        "| offer of a model | {EVEN}; {PIECES} for models in cells; {EVEN_BOUND} and {PIECES_BOUND} where bound to a session |"
    );
    assert!(include_str!("../../../../models/FORMATS.md").contains(&row), "{row}");
}

fn settings() -> UploadSettings {
    UploadSettings { chunk_kib: 16, max_model_mib: 1, ..Default::default() }
}

fn offer(bytes: usize) -> Offer {
    let dir = tempfile::tempdir().expect("temp dir");
    let path = dir.path().join("m.dgtr");
    std::fs::write(&path, vec![7; bytes]).expect("write");
    let order = Order { flight: 2, counter: 5 };
    OfferedModel::open(&path, &settings(), &Source::unsigned("m", "a1"), order, true).expect("offer").offer
}

#[test]
fn an_offer_survives_the_wire() {
    let o = offer(40_000);
    assert_eq!(o.chunks.len(), 3);
    assert_eq!((o.chunk_len(0), o.chunk_len(2), o.chunk_len(3)), (16_384, 40_000 - 32_768, 0));
    assert_eq!(Offer::decode(&o.encode(), &settings()), Ok(o));
}

/// Of a model whose cells are its chunks.
fn in_cells() -> OfferedModel {
    let dir = tempfile::tempdir().expect("temp dir");
    let path = dir.path().join("m.dgtr");
    crate::testing::write_in_cells(&path, 0.2);
    let order = Order { flight: 2, counter: 5 };
    OfferedModel::open(&path, &settings(), &Source::unsigned("m", "a1"), order, true).expect("offer")
}

#[test]
fn an_offer_of_cells_survives_the_wire_and_its_chunks_are_the_file() {
    let model = in_cells();
    let o = &model.offer;
    assert!(o.version == PIECES && o.chunks.len() > 4, "{} chunks", o.chunks.len());
    let chunks: Vec<u8> = (0..o.chunks.len()).flat_map(|i| model.chunk(i).expect("held")).collect();
    assert_eq!(blake3::hash(&chunks).as_bytes(), &o.model);
    assert_eq!(Offer::decode(&o.encode(), &settings()).as_ref(), Ok(o));
}

#[test]
fn lies_about_the_lengths_of_cells_are_refused() {
    let edit = |f: fn(&mut Offer)| {
        let mut o = in_cells().offer;
        f(&mut o);
        Offer::decode(&o.encode(), &settings())
    };
    assert!(edit(|_| ()).is_ok());
    for lie in [
        |o: &mut Offer| o.sizes[1] += 1,
        |o: &mut Offer| (o.sizes[1], o.sizes[2]) = (o.sizes[1] + o.sizes[2], 0),
        |o: &mut Offer| o.sizes[1] = u32::MAX,
        |o: &mut Offer| _ = o.sizes.pop(),
        |o: &mut Offer| _ = o.chunks.pop(),
        |o: &mut Offer| o.version = EVEN,
    ] {
        assert!(matches!(edit(lie), Err(OfferError::Damaged(_))));
    }
}

#[test]
fn every_truncated_offer_is_refused() {
    for bytes in [offer(40_000).encode(), in_cells().offer.encode()] {
        for n in 0..bytes.len() {
            assert!(Offer::decode(&bytes[..n], &settings()).is_err(), "{n} of {}", bytes.len());
        }
        // A signature may follow, and nothing else.
        for more in (1..200).filter(|&n| n != 64) {
            assert!(Offer::decode(&[&bytes[..], &vec![0; more]].concat(), &settings()).is_err());
        }
    }
}

#[test]
fn lies_about_size_and_chunks_are_refused() {
    let edit = |f: fn(&mut Offer)| {
        let mut o = offer(40_000);
        f(&mut o);
        Offer::decode(&o.encode(), &settings())
    };
    assert!(matches!(edit(|o| o.size = 1 << 40), Err(OfferError::Oversize { .. })));
    assert!(matches!(edit(|o| o.size = 0), Err(OfferError::Damaged(_))));
    assert!(matches!(edit(|o| o.chunk_bytes = 1), Err(OfferError::Damaged(_))));
    assert!(matches!(edit(|o| o.chunk_bytes = u32::MAX), Err(OfferError::Damaged(_))));
    assert!(matches!(edit(|o| o.chunks.truncate(1)), Err(OfferError::Damaged(_))));
    assert!(matches!(edit(|o| o.aircraft = "../../etc".into()), Err(OfferError::Damaged(_))));
    assert!(matches!(edit(|o| o.mission = "a/**".into()), Err(OfferError::Damaged(_))));
    assert!(matches!(edit(|o| o.version = 1), Err(OfferError::Version(1))));
}

#[test]
fn a_vast_chunk_count_does_not_allocate() {
    // version, "m", "a", flight, counter, finished, size, chunk size, hash, then a length of 2^60 hashes.
    let mut o = offer(40_000);
    o.chunks.clear();
    let mut bytes = o.encode();
    bytes.pop();
    bytes.extend([0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x0f]);
    assert!(matches!(Offer::decode(&bytes, &settings()), Err(OfferError::Damaged(_))));
}

#[test]
fn foreign_missions_and_strangers_are_told_apart() {
    let o = offer(1);
    let nobody = Identity::unsigned();
    assert_eq!(o.check("m", &["a1".into()], &nobody), Ok(()));
    assert_eq!(o.check("other", &["a1".into()], &nobody), Err(OfferError::ForeignMission("m".into())));
    assert_eq!(o.check("m", &["a2".into()], &nobody), Err(OfferError::UnknownAircraft("a1".into())));
}

#[test]
fn every_changed_byte_of_a_signed_offer_is_noticed() {
    let ids = crate::keys::testing::identities(["a1"]);
    let check = |bytes: &[u8]| {
        let offer = Offer::decode(bytes, &settings())?;
        offer.check("m", &["a1".into()], &ids[1])
    };
    let mut o = offer(40_000);
    o.signature = ids[0].sign(Domain::Offer, &o.signed_bytes());
    let bytes = o.encode();
    assert_eq!(check(&bytes), Ok(()));
    for at in 0..bytes.len() {
        for flip in [1, 0x80] {
            let mut spoilt = bytes.clone();
            spoilt[at] ^= flip;
            assert!(check(&spoilt).is_err(), "byte {at}");
        }
    }
    // Cut down to an unsigned one, or signed by the ground.
    assert!(matches!(check(&bytes[..bytes.len() - 64]), Err(OfferError::Forged { .. })));
    o.signature = ids[1].sign(Domain::Offer, &o.signed_bytes());
    assert!(matches!(check(&o.encode()), Err(OfferError::Forged { .. })));
}
