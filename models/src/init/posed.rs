//! Running a posed pair network (IterMVS's signature, and the embedded plane sweep): pictures and relative
//! projections in, depth and confidence out.
//!
//! The embedded network runs on several pictures at once, each on one thread with a session of its own: inside one picture
//! the threads of ONNX Runtime wait for each other after every operator, between pictures they need not. A user's network,
//! whose memory only its first run tells, is opened once and has all threads.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use glam::{DMat3, DMat4, DVec3};

use crate::camera::{Intrinsics, View};
use crate::onnx::manifest::{Contract, Manifest, Poses};
use crate::onnx::picture::push_planes;
use crate::onnx::session::NetworkSession;
use crate::onnx::{OnnxError, network};

use super::frame::{DepthGrid, Frame};

/// A network's bytes: shipped inside the binary, or read from the user's file.
#[derive(Debug)]
pub enum NetworkBytes {
    /// Compiled in.
    Embedded(&'static [u8]),
    /// Read from disk.
    Read(Vec<u8>),
}

impl NetworkBytes {
    /// The bytes.
    pub fn get(&self) -> &[u8] {
        match self {
            Self::Embedded(b) => b,
            Self::Read(b) => b,
        }
    }
}

/// Floats that the embedded network's session holds per pixel of a picture while it runs, inputs and outputs included
/// (measured: 53).
const EMBEDDED_FLOATS_PER_PIXEL: u64 = 64;
/// The same of a user's network; IterMVS with three views takes 397.
const OTHER_FLOATS_PER_PIXEL: u64 = 420;
/// What opening a session takes beside its weights: the graph's nodes and plans (measured: 24 MiB for the plane sweep).
const SESSION_BYTES: u64 = 28 << 20;

/// A posed network; sessions live from the first run until [`Self::close`].
#[derive(Debug)]
pub struct PosedNetwork {
    manifest: Manifest,
    bytes: NetworkBytes,
    /// ONNX Runtime's threads in each session.
    threads: usize,
    views: usize,
    lanes: Vec<Lane>,
}

/// One picture at a time.
#[derive(Debug, Default)]
struct Lane {
    session: Option<((u32, u32), NetworkSession)>,
    planes: Vec<f32>,
    opening_ms: f64,
}

/// One picture's depth to be made.
pub struct Request<'a> {
    /// The picture.
    pub reference: &'a Frame,
    /// Pictures it is compared with, best first; at least one.
    pub sources: Vec<&'a Frame>,
    /// Nearest and farthest depth, metres.
    pub range: [f32; 2],
}

/// What became of a request.
pub struct Made {
    /// The depths, at the grid's stride.
    pub grid: DepthGrid,
    /// Depths claimed that were not positive finite numbers.
    pub unsound: usize,
    /// Milliseconds of the run.
    pub run_ms: f64,
}

/// K as 4×4, so that K·T·K⁻¹ is one product.
fn k4(k: &Intrinsics) -> DMat4 {
    // IterMVS's pixel centres are at integers, ours at +0.5.
    let k3 = DMat3::from_cols(
        DVec3::new(f64::from(k.fx), 0.0, 0.0),
        DVec3::new(0.0, f64::from(k.fy), 0.0),
        DVec3::new(f64::from(k.cx) - 0.5, f64::from(k.cy) - 0.5, 1.0),
    );
    DMat4::from_mat3(k3)
}

fn world_to_camera(view: &View) -> DMat4 {
    let r = view.pose.rotation.conjugate().normalize();
    DMat4::from_rotation_translation(r, -(r * view.pose.center))
}

/// K4·T_src·T_ref⁻¹·K4⁻¹, row-major.
fn relative_projection(reference: &View, source: &View) -> [f32; 16] {
    let m = k4(&source.intrinsics)
        * world_to_camera(source)
        * world_to_camera(reference).inverse()
        * k4(&reference.intrinsics).inverse();
    m.transpose().to_cols_array().map(|v| v as f32)
}

impl PosedNetwork {
    /// Takes a manifest of contract `pair` with `poses = "given"`.
    ///
    /// # Errors
    /// Another contract.
    pub fn new(manifest: Manifest, bytes: NetworkBytes, threads: usize) -> Result<Self, OnnxError> {
        match (&manifest.contract, &manifest.pair) {
            (Contract::Pair, Some(pair)) if pair.poses == Poses::Given => {
                let views = pair.views;
                let (lanes, threads) = match bytes {
                    NetworkBytes::Embedded(_) => (threads.max(1), 1),
                    NetworkBytes::Read(_) => (1, threads),
                };
                let lanes = (0..lanes).map(|_| Lane::default()).collect();
                Ok(Self { manifest, bytes, threads, views, lanes })
            }
            _ => Err(OnnxError::Manifest {
                manifest: manifest.name,
                field: "contract",
                reason: "initialisation needs `pair`".into(),
            }),
        }
    }

    /// Its manifest.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Source pictures per run.
    pub fn sources(&self) -> usize {
        self.views - 1
    }

    /// Host bytes that its sessions take while they run on pictures of a number of pixels.
    pub fn planned_bytes(&self, pixels: u64) -> u64 {
        let floats = match self.bytes {
            NetworkBytes::Embedded(_) => EMBEDDED_FLOATS_PER_PIXEL,
            NetworkBytes::Read(_) => OTHER_FLOATS_PER_PIXEL,
        };
        let weights = self.bytes.get().len() as u64;
        self.lanes.len() as u64 * (SESSION_BYTES + 2 * weights + pixels * floats * 4)
    }

    /// Makes the depths of all requests, in their order, on every `stride`-th pixel.
    ///
    /// # Errors
    /// Of the first request that failed: ONNX Runtime or the contract.
    pub fn run_all(&mut self, requests: &[Request<'_>], stride: usize) -> Result<Vec<Made>, OnnxError> {
        let next = AtomicUsize::new(0);
        let done: Mutex<Vec<(usize, Result<Made, OnnxError>)>> = Mutex::new(Vec::with_capacity(requests.len()));
        let (manifest, bytes, threads, views) = (&self.manifest, self.bytes.get(), self.threads, self.views);
        let work = |lane: &mut Lane| {
            loop {
                let i = next.fetch_add(1, Ordering::Relaxed);
                let Some(request) = requests.get(i) else { break };
                let made = lane.run(manifest, bytes, threads, views, request, stride);
                let failed = made.is_err();
                done.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push((i, made));
                if failed {
                    next.store(requests.len(), Ordering::Relaxed);
                }
            }
        };
        let busy = requests.len().min(self.lanes.len());
        match &mut self.lanes[..busy] {
            [] => {}
            [only] => work(only),
            [first, others @ ..] => std::thread::scope(|scope| {
                for lane in others {
                    scope.spawn(|| work(lane));
                }
                work(first);
            }),
        }
        let mut done = done.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        done.sort_by_key(|(i, _)| *i);
        done.into_iter().map(|(_, made)| made).collect()
    }

    /// Milliseconds spent opening sessions so far, over all threads.
    pub fn opening_ms(&self) -> f64 {
        self.lanes.iter().map(|l| l.opening_ms).sum()
    }

    /// Gives the sessions' memory back; the next run opens them again.
    pub fn close(&mut self) {
        for lane in &mut self.lanes {
            (lane.session, lane.planes) = (None, Vec::new());
        }
    }
}

impl Lane {
    /// When the network wants more sources than there are, the best is given again.
    fn run(
        &mut self,
        manifest: &Manifest,
        bytes: &[u8],
        threads: usize,
        views: usize,
        request: &Request<'_>,
        stride: usize,
    ) -> Result<Made, OnnxError> {
        let reference = request.reference;
        let (w, h) = reference.image.dimensions();
        let session = match &mut self.session {
            Some((size, session)) if *size == (w, h) => session,
            slot => {
                let started = Instant::now();
                let session = network::open(manifest, bytes, (w, h), threads)?;
                self.opening_ms += started.elapsed().as_secs_f64() * 1e3;
                &mut slot.insert(((w, h), session)).1
            }
        };
        let started = Instant::now();
        let k = &reference.view.intrinsics;
        self.planes.clear();
        push_planes(&reference.image, w, h, &manifest.input, &mut self.planes);
        let mut projections = Vec::with_capacity(16 * (views - 1));
        for i in 0..views - 1 {
            let source = request.sources.get(i).or(request.sources.first()).copied().unwrap_or(reference);
            push_planes(&source.image, w, h, &manifest.input, &mut self.planes);
            projections.extend(relative_projection(&reference.view, &source.view));
        }
        let k_ref = [k.fx, 0.0, k.cx - 0.5, 0.0, k.fy, k.cy - 0.5, 0.0, 0.0, 1.0];
        let (rows, columns) = (h as usize, w as usize);
        let mut out = session.run(
            &[
                ("images", &[1, views, 3, rows, columns], &self.planes),
                ("rel_proj", &[views - 1, 4, 4], &projections),
                ("depth_range", &[2], &request.range),
                ("k_ref", &[3, 3], &k_ref),
            ],
            &["depth", "conf"],
        )?;
        let conf = out.pop();
        match (out.pop(), conf) {
            (Some(depth), Some(conf)) if depth.shape == [1, 1, rows, columns] && conf.shape == depth.shape => {
                let (grid, unsound) = DepthGrid::sampled(columns, rows, stride, &depth.data, &conf.data);
                Ok(Made { grid, unsound, run_ms: started.elapsed().as_secs_f64() * 1e3 })
            }
            _ => Err(OnnxError::Contract {
                network: manifest.name.clone(),
                contract: "pair",
                tensor: "outputs `depth`, `conf`".into(),
                expected: format!("[1,1,{rows},{columns}]"),
                found: "other shapes".into(),
            }),
        }
    }
}
