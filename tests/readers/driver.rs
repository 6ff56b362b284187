//! One driver for the readers of all crates: whatever a file or a wire brings, no reader panics, its memory stays in
//! proportion to the input, its error is one line without control characters that names the file, and what it accepts is usable.
//! However deep the input is nested, it stays within the 2 MiB of a thread's stack, and it ends. Pipes, sockets, devices, folders and
//! links in a file's place are refused or done without; none is waited for. 10⁵ inputs for each reader, or a tenth of them, from a
//! fixed seed; `DGTR_FUZZ_INPUTS` sets another number. Overflow checks are on in the profile that builds it.
//!
//! The `tests/readers.rs` of each crate that reads includes this file by its path.
#![allow(dead_code, reason = "each crate's tests use their part")]

use std::cell::RefCell;
use std::fs::File;
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

pub mod memory;
mod mutation;
mod patience;

pub use mutation::Random;
use mutation::mutate;
use patience::Patience;

/// About as large are the largest inputs.
const LARGEST: usize = 200_000;
/// Inputs for each reader unless the environment says otherwise.
const INPUTS: usize = 100_000;

/// `Ok`: accepted, and whether what was accepted is usable. `Err`: the line that refuses it.
pub type Verdict = Result<bool, String>;

/// What is fed.
pub enum Read<'a> {
    /// A file of this name in a folder of its own; a refusal must name either.
    File(&'static str, &'a dyn Fn(&Path) -> Verdict),
    /// Bytes off a wire.
    Bytes(&'a dyn Fn(&[u8]) -> Verdict),
}

/// A reader under test.
pub struct Reader<'a> {
    pub name: &'static str,
    /// Whole inputs, all of which are accepted.
    pub seeds: Vec<Vec<u8>>,
    /// Mutated as text rather than as words.
    pub text: bool,
    /// A shell around the content that hides it from mutation (checksum, compression): taken off and put on again for half
    /// of the inputs.
    pub shell: Option<Shell>,
    /// Bytes that reading may take whatever the input holds, and for each byte of it.
    pub memory: (usize, usize),
    pub read: Read<'a>,
}

/// Takes a shell off and puts it on.
#[derive(Clone, Copy)]
pub struct Shell {
    pub open: fn(&[u8]) -> Vec<u8>,
    pub close: fn(Vec<u8>) -> Vec<u8>,
}

/// Feeds the reader; says how many inputs were accepted and what the most memory was.
pub fn survive(reader: &Reader<'_>) {
    survive_part(reader, 1);
}

/// As [`survive`], one of so many of the inputs: for a reader that opens many files for each.
pub fn survive_part(reader: &Reader<'_>, part: usize) {
    let Reader { name, seeds, .. } = reader;
    let inputs = std::env::var("DGTR_FUZZ_INPUTS").ok().and_then(|n| n.parse().ok()).unwrap_or(INPUTS) / part;
    let (folder, input) = (memory_folder(), RefCell::new(None));
    let verdict = |bytes: &[u8]| match reader.read {
        Read::Bytes(read) => read(bytes),
        Read::File(file, read) => {
            let path = folder.path().join(file);
            write(&mut input.borrow_mut(), &path, bytes).expect("written");
            read(&path)
        }
    };
    let named = |line: &str| match reader.read {
        Read::Bytes(_) => true,
        Read::File(file, _) => line.contains(file) || line.contains(&*folder.path().to_string_lossy()),
    };
    let patience = Patience::with(name);
    for (i, seed) in seeds.iter().enumerate() {
        assert_eq!(verdict(seed), Ok(true), "{name}: whole input {i} is accepted");
    }
    let (start, mut random) = (Instant::now(), Random::new(1));
    let (mut accepted, mut largest, mut longest) = (0, 0, Duration::ZERO);
    for i in 0..inputs {
        let [seed, other] = [(); 2].map(|()| &seeds[random.below(seeds.len())]);
        let bytes = match reader.shell.filter(|_| i % 2 == 0) {
            Some(shell) => (shell.close)(mutate(&(shell.open)(seed), &(shell.open)(other), reader.text, &mut random)),
            None => mutate(seed, other, reader.text, &mut random),
        };
        let keep = |why: &str| {
            let kept = std::env::temp_dir().join(format!("{name}-{i}.input"));
            std::fs::write(&kept, &bytes).expect("written");
            panic!("{name} input {i}: {why}; kept as {}", kept.display())
        };
        patience.begin(i);
        let from = Instant::now();
        let (read, held) = memory::peak(|| catch_unwind(AssertUnwindSafe(|| verdict(&bytes))));
        longest = longest.max(from.elapsed());
        match read {
            Err(_) => keep("the reader panicked"),
            Ok(Err(line)) if line.contains(is_obeyed) || !named(&line) => keep(&format!("says {line:?}")),
            Ok(Err(_)) => {}
            Ok(Ok(false)) => keep("what was accepted is not usable"),
            Ok(Ok(true)) => accepted += 1,
        }
        if held > reader.memory.0 + reader.memory.1 * bytes.len() {
            keep(&format!("{held} bytes held for an input of {}", bytes.len()));
        }
        largest = largest.max(held);
    }
    let (seconds, longest_ms) = (start.elapsed().as_secs_f64(), longest.as_secs_f64() * 1e3);
    println!(
        "{name}: {inputs} inputs, {accepted} accepted, {largest} bytes held at most, {longest_ms:.1} ms at most, {seconds:.1} s"
    );
    if let Read::File(file, read) = reader.read {
        for (i, kind) in patience::KINDS.into_iter().enumerate() {
            patience.begin(inputs + i);
            let path = folder.path().join(file);
            patience::put(kind, &path);
            let (said, held) = memory::peak(|| catch_unwind(AssertUnwindSafe(|| read(&path))));
            match said {
                Err(_) => panic!("{name}: panicked at {kind:?}"),
                Ok(Err(line)) => {
                    assert!(!line.contains(is_obeyed) && named(&line), "{name} says {line:?} of {kind:?}")
                }
                // Some readers do without the file.
                Ok(Ok(usable)) => assert!(usable, "{name}: {kind:?} is not usable"),
            }
            assert!(held <= reader.memory.0 + reader.memory.1 * LARGEST, "{name}: {held} bytes held for {kind:?}");
        }
    }
    // Neither all refused at the door nor all let through.
    assert!(accepted * 1000 > inputs && accepted < inputs, "{name}: {accepted} of {inputs} accepted");
}

/// What a terminal or a log obeys; a tab is a gap.
fn is_obeyed(c: char) -> bool {
    c.is_control() && c != '\t'
}

/// Writes the next input into the file of the one before: half of the time of making it anew. A reader may have taken that
/// file away.
fn write(file: &mut Option<File>, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    if let Some(open) = file.as_ref()
        && open.metadata()?.nlink() > 0
    {
        open.write_all_at(bytes, 0)?;
        return open.set_len(bytes.len() as u64);
    }
    // As secrets lie on a disk.
    let new = File::options().write(true).create(true).truncate(true).mode(0o600).open(path)?;
    new.write_all_at(bytes, 0)?;
    *file = Some(new);
    Ok(())
}

/// A folder in memory where there is one: the inputs are many and none is kept.
pub fn memory_folder() -> tempfile::TempDir {
    let folder = ["/dev/shm"].into_iter().find(|f| Path::new(f).is_dir()).map(tempfile::tempdir_in);
    folder.unwrap_or_else(tempfile::tempdir).expect("a folder for the inputs")
}

/// `Ok` with whether it is usable, or the error's line.
pub fn line<T, E: std::fmt::Display>(read: Result<T, E>, usable: impl FnOnce(T) -> bool) -> Verdict {
    read.map(usable).map_err(|e| e.to_string())
}
