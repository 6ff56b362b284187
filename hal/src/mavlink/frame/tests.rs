//! Promises of the framer.

use super::*;
use crate::mavlink::Encoder;
use crate::mavlink::dialect::{HEARTBEAT_DATA, SYSTEM_TIME_DATA};

fn stream() -> std::vec::Vec<u8> {
    let mut encoder = Encoder::new(1, 1);
    let mut bytes = std::vec::Vec::new();
    for i in 0..5u32 {
        let time = SYSTEM_TIME_DATA { time_unix_usec: 7, time_boot_ms: i | 1 << 24 }; // all of one length
        bytes.extend_from_slice(encoder.encode(&time, None));
    }
    bytes
}

fn boot_times(framer: &mut Framer) -> std::vec::Vec<u32> {
    let mut found = std::vec::Vec::new();
    while let Some(frame) = framer.next_frame() {
        found.extend(frame.message::<SYSTEM_TIME_DATA>().map(|m| m.time_boot_ms & 0xFF));
    }
    found
}

#[test]
fn frames_split_at_any_byte_are_found_once() {
    let mut framer = Framer::new();
    let mut found = std::vec::Vec::new();
    for byte in stream() {
        assert_eq!(framer.push(&[byte]), 1);
        found.extend(boot_times(&mut framer));
    }
    assert_eq!(found, [0, 1, 2, 3, 4]);
    assert_eq!(framer.counters().damaged, 0);
}

#[test]
fn one_damaged_byte_costs_one_frame_and_is_counted() {
    let clean = stream();
    let len = clean.len() / 5;
    for position in len..2 * len {
        let mut bytes = clean.clone();
        bytes[position] ^= 0x41;
        let mut framer = Framer::new();
        framer.push(&bytes);
        // A flipped length byte may ask for more than there is; further traffic resolves it.
        framer.push(&[0; 300]);
        let found = boot_times(&mut framer);
        assert_eq!(found, [0, 2, 3, 4], "byte {position}");
        assert!(framer.counters().damaged + framer.counters().unknown >= 1);
    }
}

#[test]
fn lost_bytes_do_not_cost_the_next_frame() {
    let mut bytes = stream();
    let len = bytes.len() / 5;
    bytes.drain(len + 3..len + 9);
    let mut framer = Framer::new();
    framer.push(&bytes);
    assert_eq!(boot_times(&mut framer), [0, 2, 3, 4]);
}

#[test]
fn an_unknown_message_is_no_frame_though_a_checksum_without_its_number_is_right() {
    let whole = stream();
    // An id of MAVLink 1 that the dialect does not have, around all of the stream.
    let id = (0..=u8::MAX).find(|id| MavMessage::default_message_from_id((*id).into()).is_none()).expect("one");
    let mut bytes = std::vec![STX_V1, whole.len() as u8, 0, 1, 1, id];
    bytes.extend_from_slice(&whole);
    let sum = calculate_crc(&bytes[1..], 0);
    bytes.extend_from_slice(&sum.to_le_bytes());
    let mut framer = Framer::new();
    assert_eq!(framer.push(&bytes), bytes.len());
    assert_eq!(boot_times(&mut framer), [0, 1, 2, 3, 4], "what it holds is not lost");
}

#[test]
fn a_whole_frame_of_an_unknown_message_is_counted_and_no_damage() {
    // Its payload holds start bytes, its checksum cannot be known.
    let unknown = [STX_V2, 4, 0, 0, 9, 1, 1, 0xF0, 0xFF, 0xFF, STX_V2, 0, STX_V1, 3, 0xAA, 0xBB];
    let bytes = [&stream()[..], &unknown, &stream()].concat();
    for cut in 1..40 {
        let mut framer = Framer::new();
        let mut found = std::vec::Vec::new();
        for chunk in bytes.chunks(cut) {
            framer.push(chunk);
            found.extend(boot_times(&mut framer));
        }
        assert_eq!(found, [0, 1, 2, 3, 4, 0, 1, 2, 3, 4]);
        let counters = framer.counters();
        assert_eq!((counters.unknown, counters.damaged, counters.skipped_bytes), (1, 0, 0), "pieces of {cut}");
    }
}

#[test]
fn another_message_is_not_taken_for_the_one_asked_for() {
    let mut framer = Framer::new();
    framer.push(&stream());
    let frame = framer.next_frame().expect("a frame");
    assert!(frame.message::<HEARTBEAT_DATA>().is_none());
    assert_eq!((frame.system(), frame.component(), frame.sequence(), frame.id()), (1, 1, 0, 2));
}
