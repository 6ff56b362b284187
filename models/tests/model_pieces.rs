//! A checkpoint written piece by piece, and its host memory.
//!
//! One test at a time, because the mark is the process's.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]
#![allow(unsafe_code, reason = "the allocator that knows the peak")]

#[path = "../../tests/peak_allocator.rs"]
mod peak_allocator;

use std::io;
use std::path::Path;

use disk::{Disk, previous};
use models::cloud::GaussianCloud;
use models::formats::FormatError;
use models::formats::model::{
    self, Chunks, ModelHeader, open_checkpoint, piece_bytes, write_checkpoint, write_checkpoint_pieces,
};
use peak_allocator::peak_of;

static ALONE: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Rows of a scene that is made as it is read.
fn rows(from: usize, count: usize) -> GaussianCloud {
    let mut cloud = GaussianCloud::with_capacity(3, count);
    for i in from..from + count {
        let x = i as f32;
        let sh: [f32; 48] = std::array::from_fn(|k| (x * 0.37 + k as f32).sin());
        cloud.push([x, 0.5 * x, -x], [-1.0, -2.0, x * 1e-6], [1.0, 0.0, x * 1e-6, 0.0], 0.1, &sh);
    }
    cloud
}

fn write(path: &Path, count: usize, piece: usize) -> Result<(), FormatError> {
    let mut pieces = |take: &mut dyn FnMut(&GaussianCloud) -> io::Result<()>| {
        (0..count).step_by(piece).try_for_each(|from| take(&rows(from, piece.min(count - from))))
    };
    write_checkpoint_pieces(&Disk::default(), path, &header(), (count, 3), &mut pieces)
}

fn header() -> ModelHeader {
    ModelHeader { mission: "pieces".into(), steps: 7, ..ModelHeader::default() }
}

#[test]
fn a_checkpoint_in_pieces_is_the_one_of_the_whole_to_the_byte_and_keeps_the_one_before() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let [whole, path] = ["whole.dgtr", "model.dgtr"].map(|name| folder.path().join(name));
    write_checkpoint(&Disk::default(), &whole, &header(), &rows(0, 1000)).unwrap();
    for piece in [1000, 300, 1] {
        write(&path, 1000, piece).unwrap();
        assert!(std::fs::read(&path).unwrap() == std::fs::read(&whole).unwrap(), "pieces of {piece}");
    }
    write(&path, 10, 4).unwrap();
    assert_eq!(model::read(&previous(&path)).unwrap().1.len(), 1000);
    let opened = open_checkpoint(&Disk::default(), &path).unwrap().unwrap();
    assert_eq!((opened.count, opened.header.steps), (10, 7));
}

#[test]
fn pieces_that_fail_or_are_too_few_leave_what_was_saved() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.dgtr");
    write(&path, 50, 10).unwrap();
    let before = std::fs::read(&path).unwrap();
    for (given, fails) in [(40, false), (60, false), (40, true)] {
        let mut pieces = |take: &mut dyn FnMut(&GaussianCloud) -> io::Result<()>| {
            take(&rows(0, given))?;
            if fails { Err(io::Error::other("the trainer failed")) } else { Ok(()) }
        };
        let error = write_checkpoint_pieces(&Disk::default(), &path, &header(), (50, 3), &mut pieces).unwrap_err();
        let line = error.to_string();
        assert!(line.contains("model.dgtr") && !line.contains('\n'), "{line}");
        assert!(line.contains(if fails { "the trainer failed" } else { "another length" }), "{line}");
        assert!(std::fs::read(&path).unwrap() == before);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "half a file was left");
    }
    // A damaged one is set aside, and the older one found.
    write(&path, 20, 10).unwrap();
    let mut garbled = std::fs::read(&path).unwrap();
    garbled[2000] ^= 4;
    std::fs::write(&path, garbled).unwrap();
    assert_eq!(open_checkpoint(&Disk::default(), &path).unwrap().unwrap().count, 50);
    assert!(folder.path().join("model.damaged-1.dgtr").exists());
}

#[test]
fn memory_does_not_grow_with_the_scene() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.dgtr");
    let most = [50_000, 200_000].map(|count| {
        let (_, out) = peak_of(|| write(&path, count, 4_000).unwrap());
        let (_, back) = peak_of(|| {
            let mut seen = 0;
            let chunks = Chunks::open(&path).unwrap();
            let each = chunks.each::<FormatError>(&mut |piece| {
                seen += piece.len();
                Ok(())
            });
            assert_eq!((each.unwrap(), seen), (0, count));
        });
        [out, back]
    });
    println!("{most:?} bytes for 50,000 and 200,000 Gaussians of 236");
    let grows = |k: usize| most[1][k] > most[0][k] + (4 << 10);
    assert!(![0, 1].into_iter().any(grows), "{most:?}");
    assert!(most[1].iter().all(|bytes| (*bytes as u64) < 2 * piece_bytes(3)), "{most:?}");
}

#[test]
fn a_sample_is_evenly_chosen_over_all_pieces_and_holds_constant_colours() {
    let _alone = ALONE.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.dgtr");
    // Two whole pieces of 16,384 and a part of a third.
    let (count, most) = (40_000, 700);
    write(&path, count, 10_000).unwrap();
    let model = Chunks::open(&path).unwrap();
    let sample = model.sample(most).unwrap();
    let every = count.div_ceil(most);
    let chosen: Vec<f32> = (0..count).step_by(every).map(|i| i as f32).collect();
    assert_eq!(sample.means.iter().map(|m| m[0]).collect::<Vec<_>>(), chosen);
    assert_eq!((sample.sh_degree, sample.sh.len()), (0, 3 * chosen.len()));
    assert_eq!(model.sample(count).unwrap().len(), count);
}
