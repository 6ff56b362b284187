//! One ONNX Runtime session with bounded memory: spinning threads are off (a companion computer shares its cores), and so is the
//! arena, memory is planned from fixed shapes, and one or two threads work. A run ends when it takes too long or when the process is
//! asked to end.
//!
//! The library is loaded at run time, so that the binary starts on a board without it and says what is missing.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ort::environment::Environment;
use ort::session::builder::GraphOptimizationLevel;
use ort::session::{RunOptions, Session};
use ort::value::{TensorElementType, TensorRef, ValueType};

use super::OnnxError;
use crate::formats::one_line;

/// Name, element type and shape of an input or output as the file declares it; −1 where the file leaves it open.
#[derive(Clone, Debug, PartialEq)]
pub struct TensorSpec {
    /// Name in the graph.
    pub name: String,
    /// True for 32-bit floats, the only type the contracts use.
    pub is_f32: bool,
    /// Dimensions, −1 = any.
    pub shape: Vec<i64>,
}

/// A dense f32 tensor that came out of a network.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Dimensions.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub data: Vec<f32>,
}

/// An input: name, dimensions, row-major values.
pub type Input<'a> = (&'a str, &'a [usize], &'a [f32]);

/// An opened network.
#[derive(Debug)]
pub struct NetworkSession {
    name: String,
    session: Session,
    /// Contract's name → the file's, where they differ.
    names: BTreeMap<String, String>,
    inputs: Vec<TensorSpec>,
    outputs: Vec<TensorSpec>,
}

impl NetworkSession {
    /// Opens a network from its bytes. `dimensions` pins symbolic dimensions (`("h", 480)`) so that the runtime can
    /// plan its memory; unknown names are ignored by the runtime. `names` says what the file calls a tensor of the
    /// contract; everywhere else it goes by the contract's name.
    ///
    /// # Errors
    /// The library is missing or unusable, or the bytes are no network it can run.
    pub fn open(
        name: &str,
        bytes: &[u8],
        threads: usize,
        dimensions: &[(&str, usize)],
        names: &BTreeMap<String, String>,
    ) -> Result<Self, OnnxError> {
        let environment = environment()?;
        let fail = |e: String| OnnxError::Runtime { network: name.to_owned(), reason: e };
        let build = || -> ort::Result<Session> {
            let mut b = Session::builder(environment)?
                .with_execution_providers([ort::ep::CPU::default().with_arena_allocator(false).build()])?
                .with_memory_pattern(true)?
                .with_intra_op_spinning(false)?
                .with_inter_op_spinning(false)?
                .with_intra_threads(threads.clamp(1, 64))?
                .with_inter_threads(1)?
                .with_optimization_level(GraphOptimizationLevel::All)?;
            for (symbol, size) in dimensions {
                b = b.with_dimension_override(symbol, *size as i64)?;
            }
            b.commit_from_memory(bytes)
        };
        let session = build().map_err(|e| fail(one_line(e)))?;
        let specs = |outlets: &[ort::value::Outlet]| outlets.iter().map(|o| spec(o, names)).collect::<Vec<_>>();
        let (inputs, outputs) = (specs(session.inputs()), specs(session.outputs()));
        Ok(Self { name: name.to_owned(), session, names: names.clone(), inputs, outputs })
    }

    /// What the network was called when it was opened.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Declared inputs.
    pub fn inputs(&self) -> &[TensorSpec] {
        &self.inputs
    }

    /// Declared outputs.
    pub fn outputs(&self) -> &[TensorSpec] {
        &self.outputs
    }

    /// Runs once and copies out the outputs in `wanted`, in that order.
    ///
    /// # Errors
    /// ONNX Runtime refused the inputs or failed; it did not end in time; an output in `wanted` is missing or not f32.
    pub fn run(&mut self, inputs: &[Input<'_>], wanted: &[&str]) -> Result<Vec<Tensor>, OnnxError> {
        let floats: usize = inputs.iter().map(|(_, _, data)| data.len()).sum();
        let asked = ASKED.lock().unwrap_or_else(PoisonError::into_inner).clone();
        self.run_within(time_limit(floats), asked, inputs, wanted)
    }

    fn run_within(
        &mut self,
        limit: Duration,
        asked: Option<Arc<AtomicBool>>,
        inputs: &[Input<'_>],
        wanted: &[&str],
    ) -> Result<Vec<Tensor>, OnnxError> {
        let network = self.name.clone();
        let fail = |reason: String| OnnxError::Runtime { network: network.clone(), reason };
        let mut values = Vec::with_capacity(inputs.len());
        for &(name, shape, data) in inputs {
            let tensor = TensorRef::from_array_view((shape.to_vec(), data))
                .map_err(|e| fail(format!("input {name}: {}", one_line(e))))?;
            values.push((self.names.get(name).map_or(name, String::as_str), tensor));
        }
        let options = RunOptions::new().map_err(|e| fail(one_line(e)))?;
        let watch = Watch::start(options, limit, asked).map_err(|e| fail(one_line(e)))?;
        let watched = watch.shared.clone();
        let results = self.session.run_with_options(values, &watched.options);
        let ending = watch.end();
        let too_long = || format!("did not end within {} s; an endless loop, or too large a network", limit.as_secs());
        let results = results.map_err(|e| match ending {
            Ending::Asked => OnnxError::Stopped { network: network.clone() },
            Ending::OverTime => fail(too_long()),
            Ending::Itself => fail(one_line(e)),
        })?;
        wanted
            .iter()
            .map(|&name| {
                let in_file = self.names.get(name).map_or(name, String::as_str);
                let value = results.get(in_file).ok_or_else(|| fail(format!("has no output `{name}`")))?;
                let (shape, data) =
                    value.try_extract_tensor::<f32>().map_err(|e| fail(format!("output {name}: {}", one_line(e))))?;
                Ok(Tensor { shape: shape.iter().map(|&d| d as usize).collect(), data: data.to_vec() })
            })
            .collect()
    }
}

/// A run is ended after this, and so much longer for every million numbers that go in: ten times what the slowest network in use takes
/// on a Raspberry Pi 5. A network's loop may have no end.
const LIMIT: Duration = Duration::from_secs(5);
const LIMIT_PER_MILLION: f64 = 120.0;

fn time_limit(floats: usize) -> Duration {
    LIMIT + Duration::from_secs_f64(LIMIT_PER_MILLION * floats as f64 / 1e6)
}

/// How often it is looked whether somebody asks for the end.
const LOOK_UP: Duration = Duration::from_millis(200);
/// Set when the process is asked to end.
static ASKED: Mutex<Option<Arc<AtomicBool>>> = Mutex::new(None);

/// From now on every run ends soon after `asked` is set.
pub fn end_when(asked: Arc<AtomicBool>) {
    *ASKED.lock().unwrap_or_else(PoisonError::into_inner) = Some(asked);
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    /// It was done, or failed.
    Itself,
    /// It took too long.
    OverTime,
    /// The process was asked to end.
    Asked,
}

/// What the run and its watch share.
struct Watched {
    options: RunOptions,
    ended: Mutex<bool>,
    bell: Condvar,
}

/// Ends a run that takes too long, or that nobody waits for any more.
struct Watch {
    shared: Arc<Watched>,
    thread: JoinHandle<Ending>,
}

impl Watch {
    fn start(options: RunOptions, limit: Duration, asked: Option<Arc<AtomicBool>>) -> std::io::Result<Self> {
        let shared = Arc::new(Watched { options, ended: Mutex::new(false), bell: Condvar::new() });
        let watched = shared.clone();
        let watch = move || {
            let until = Instant::now() + limit;
            let mut ended = watched.ended.lock().unwrap_or_else(PoisonError::into_inner);
            let ending = loop {
                let left = until.saturating_duration_since(Instant::now());
                match () {
                    () if *ended => break Ending::Itself,
                    () if left.is_zero() => break Ending::OverTime,
                    () if asked.as_ref().is_some_and(|asked| asked.load(Ordering::Relaxed)) => break Ending::Asked,
                    () => {}
                }
                let wait = if asked.is_some() { left.min(LOOK_UP) } else { left };
                ended = watched.bell.wait_timeout(ended, wait).unwrap_or_else(PoisonError::into_inner).0;
            };
            if ending != Ending::Itself {
                // It can only fail where there is nothing to end.
                let _ = watched.options.terminate();
            }
            ending
        };
        Ok(Self { shared, thread: std::thread::Builder::new().name("onnx-limit".into()).spawn(watch)? })
    }

    /// The run is over; what ended it.
    fn end(self) -> Ending {
        *self.shared.ended.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.shared.bell.notify_all();
        self.thread.join().unwrap_or(Ending::Itself)
    }
}

fn spec(outlet: &ort::value::Outlet, names: &BTreeMap<String, String>) -> TensorSpec {
    let (is_f32, shape) = match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => (*ty == TensorElementType::Float32, shape.iter().copied().collect()),
        _ => (false, Vec::new()),
    };
    let contract = names.iter().find(|(_, in_file)| *in_file == outlet.name()).map(|(contract, _)| contract.as_str());
    TensorSpec { name: contract.unwrap_or(outlet.name()).to_owned(), is_f32, shape }
}

/// The places where the runtime library may be, in order.
fn library_candidates() -> Vec<PathBuf> {
    if let Some(path) = std::env::var_os("ORT_DYLIB_PATH").filter(|p| !p.is_empty()) {
        // The user has said which; another one found by luck would only confuse.
        return vec![PathBuf::from(path)];
    }
    const FILE: &str = "libonnxruntime.so";
    let mut places = Vec::new();
    if let Some(home) = std::env::var_os("HOME") {
        places.push(PathBuf::from(home).join(".local/share/dgtr/lib").join(FILE));
    }
    if let Some(folder) = std::env::current_exe().ok().and_then(|p| p.parent().map(PathBuf::from)) {
        places.push(folder.join(FILE));
        places.push(folder.join("../lib").join(FILE));
        // The Debian package's own.
        places.push(folder.join("../lib/dgtr").join(FILE));
    }
    for folder in ["/usr/local/lib", "/usr/lib", "/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/lib"] {
        places.push(PathBuf::from(folder).join(FILE));
    }
    places
}

/// The runtime library that would be used, if any.
///
/// # Errors
/// [`OnnxError::LibraryMissing`] with the places tried.
pub fn find_library() -> Result<PathBuf, OnnxError> {
    let places = library_candidates();
    places.iter().find(|p| p.is_file()).cloned().ok_or_else(|| OnnxError::LibraryMissing {
        searched: places.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", "),
    })
}

/// Loads the runtime library unless it is loaded, and says where it came from; for `dgtr doctor`.
///
/// # Errors
/// As [`NetworkSession::open`].
pub fn check_library() -> Result<PathBuf, OnnxError> {
    let path = find_library()?;
    environment()?;
    Ok(path)
}

/// The one environment of the process; a failure is not remembered, so that a library installed meanwhile is found.
fn environment() -> Result<&'static Environment, OnnxError> {
    static ENVIRONMENT: OnceLock<Environment> = OnceLock::new();
    static OPENING: std::sync::Mutex<()> = std::sync::Mutex::new(());
    if let Some(environment) = ENVIRONMENT.get() {
        return Ok(environment);
    }
    let _one_at_a_time = OPENING.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if let Some(environment) = ENVIRONMENT.get() {
        return Ok(environment);
    }
    let path = find_library()?;
    let unusable = |e: String| OnnxError::Library { path: path.display().to_string(), reason: e };
    let environment = ort::init_from(&path)
        .map_err(|e| unusable(one_line(e)))?
        .with_name("dgtr")
        .with_telemetry(false)
        .build()
        .map_err(|e| unusable(one_line(e)))?;
    environment.set_log_level(ort::logging::LogLevel::Error);
    Ok(ENVIRONMENT.get_or_init(|| environment))
}

#[cfg(test)]
mod tests {
    use super::super::external::writing::{bytes, int};
    use super::*;

    /// A network that gives back `a`, by a Loop whose body says each time whether it goes on.
    fn network_with_a_loop(goes_on: bool) -> Vec<u8> {
        let value = |name: &str, element: u64| {
            let scalar = bytes(1, &[int(1, element), bytes(2, &[])].concat());
            [bytes(1, name.as_bytes()), bytes(2, &scalar)].concat()
        };
        let (float, int64, boolean) = (1, 7, 9);
        let identity = |from: &[u8], to: &[u8]| [bytes(1, from), bytes(2, to), bytes(4, b"Identity")].concat();
        let constant = |name: &[u8], truth: bool| {
            [int(2, boolean), int(5, truth.into()), bytes(8, name)].concat() // int32_data
        };
        let body = [
            bytes(1, &identity(b"goes_on", b"still")),
            bytes(1, &identity(b"before", b"after")),
            bytes(2, b"body"),
            bytes(5, &constant(b"goes_on", goes_on)),
            bytes(11, &value("turn", int64)),
            bytes(11, &value("condition", boolean)),
            bytes(11, &value("before", float)),
            bytes(12, &value("still", boolean)),
            bytes(12, &value("after", float)),
        ];
        let attribute = [bytes(1, b"body"), bytes(6, &body.concat()), int(20, 5)].concat();
        let turns = [bytes(1, b""), bytes(1, b"yes"), bytes(1, b"a"), bytes(2, b"result"), bytes(4, b"Loop")];
        let graph = [
            bytes(1, &[turns.concat(), bytes(5, &attribute)].concat()),
            bytes(2, b"graph"),
            bytes(5, &constant(b"yes", true)),
            bytes(11, &value("a", float)),
            bytes(12, &value("result", float)),
        ];
        [int(1, 8), bytes(7, &graph.concat()), bytes(8, &int(2, 17))].concat()
    }

    #[test]
    fn a_network_whose_loop_never_ends_is_ended_in_one_line_and_one_that_ends_is_left_alone() {
        if environment().is_err() {
            needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
            return;
        }
        let (hour, asked) = (Duration::from_secs(3600), Arc::new(AtomicBool::new(false)));
        let run = |goes_on, limit| {
            let network = network_with_a_loop(goes_on);
            let mut session = NetworkSession::open("loop", &network, 1, &[], &BTreeMap::new()).unwrap();
            session.run_within(limit, Some(Arc::clone(&asked)), &[("a", &[], &[2.5])], &["result"])
        };
        assert_eq!(run(false, hour).unwrap()[0].data, [2.5]);
        let line = run(true, Duration::from_secs(1)).unwrap_err().to_string();
        assert!(line.contains("did not end within 1 s") && !line.contains('\n'), "{line}");
        std::thread::scope(|scope| {
            let endless = scope.spawn(|| run(true, hour));
            asked.store(true, Ordering::Relaxed);
            assert!(matches!(endless.join().unwrap(), Err(OnnxError::Stopped { .. })));
        });
        assert!(time_limit(0) == LIMIT && time_limit(1_000_000) > 8 * LIMIT);
    }

    #[test]
    fn a_library_that_is_there_but_cannot_be_opened_is_not_called_found() {
        const NAME: &str = "onnx::session::tests::a_library_that_is_there_but_cannot_be_opened_is_not_called_found";
        const CHILD: &str = "DGTR_TEST_CHILD";
        if std::env::var_os(CHILD).is_some() {
            let e = check_library().unwrap_err();
            assert!(matches!(e, OnnxError::Library { .. }) && !e.to_string().contains('\n'), "{e}");
            return;
        }
        // As another architecture's library is, to the loader.
        let folder = tempfile::tempdir().unwrap();
        let library = folder.path().join("libonnxruntime.so");
        std::fs::write(&library, b"\x7fELF and nothing that this machine could run").unwrap();
        let child = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", NAME])
            .envs([(CHILD, "1".as_ref()), ("ORT_DYLIB_PATH", library.as_os_str())])
            .output()
            .unwrap();
        assert!(child.status.success(), "{}", String::from_utf8_lossy(&child.stdout));
        assert!(String::from_utf8_lossy(&child.stdout).contains("1 passed"), "the child ran another test");
    }
}
