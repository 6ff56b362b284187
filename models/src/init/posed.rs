//! Running a posed pair network (IterMVS's signature, and the embedded plane sweep): pictures and relative
//! projections in, depth and confidence out.
//!
//! The embedded network runs on several pictures at once, each on one thread with a session of its own: inside one picture
//! the threads of ONNX Runtime wait for each other after every operator, between pictures they need not. A user's network,
//! whose memory only its first run tells, is opened once and has all threads.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use glam::{DMat3, DMat4, DVec3};

use crate::camera::{Intrinsics, View};
use crate::onnx::network::{LazySession, Network};
use crate::onnx::picture::push_planes;

use super::InitError;
use super::depth_frame::{DepthFrame, DepthGrid};
use super::edges;

/// Floats that the embedded network's session holds per pixel of a picture while it runs, inputs and outputs included
/// (measured: 53).
const EMBEDDED_FLOATS_PER_PIXEL: u64 = 64;
/// Floats per pixel of a user's network; IterMVS with three views takes 397.
const OTHER_FLOATS_PER_PIXEL: u64 = 420;
/// What opening a session takes beside its weights: the graph's nodes and plans (measured: 24 MiB for the plane sweep).
const SESSION_BYTES: u64 = 28 << 20;

/// A posed network; sessions live from the first run until [`Self::close`].
#[derive(Debug)]
pub struct PosedNetwork {
    network: Arc<Network>,
    views: usize,
    lanes: Vec<Lane>,
}

/// One picture at a time.
#[derive(Debug)]
struct Lane {
    session: LazySession,
    planes: Vec<f32>,
    /// Its windows carry a surface's depth over the edge.
    grows_edges: bool,
}

/// One picture's depth to be made.
pub struct Request<'a> {
    /// The picture.
    pub reference: &'a DepthFrame,
    /// Pictures it is compared with, best first; at least one.
    pub sources: Vec<&'a DepthFrame>,
    /// Nearest and farthest depth, metres.
    pub range: [f32; 2],
}

/// What became of a request.
pub struct Made {
    /// The depths, at the grid's stride.
    pub grid: DepthGrid,
    /// Depths claimed that were not positive finite numbers.
    pub non_finite: usize,
    /// Depths that were moved from a step's near side to the surface behind it.
    pub moved: usize,
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
    /// Of a network of contract `pair` with `poses = "given"` that takes `views` pictures.
    pub fn new(network: Arc<Network>, views: usize, threads: usize) -> Self {
        let (lanes, threads) = if network.is_embedded() { (threads.max(1), 1) } else { (1, threads) };
        let session = || LazySession::new(Arc::clone(&network), threads);
        let lane = || Lane {
            session: if network.is_embedded() { session().in_series() } else { session() },
            planes: Vec::new(),
            grows_edges: network.is_embedded(),
        };
        Self { views, lanes: std::iter::repeat_with(lane).take(lanes).collect(), network }
    }

    /// Source pictures per run.
    pub fn sources(&self) -> usize {
        self.views - 1
    }

    /// Host bytes that its sessions take while they run on pictures of a number of pixels.
    pub fn planned_bytes(&self, pixels: u64) -> u64 {
        let floats = if self.network.is_embedded() { EMBEDDED_FLOATS_PER_PIXEL } else { OTHER_FLOATS_PER_PIXEL };
        self.lanes.len() as u64 * (SESSION_BYTES + 2 * self.network.file_bytes() + pixels * floats * 4)
    }

    /// Makes the depths of all requests, in their order, on every `stride`-th pixel.
    ///
    /// # Errors
    /// Of the first request that failed: ONNX Runtime, the contract, or the frames' file.
    pub fn run_all(&mut self, requests: &[Request<'_>], stride: usize) -> Result<Vec<Made>, InitError> {
        let next = AtomicUsize::new(0);
        let done: Mutex<Vec<(usize, Result<Made, InitError>)>> = Mutex::new(Vec::with_capacity(requests.len()));
        let views = self.views;
        let work = |lane: &mut Lane| {
            loop {
                let i = next.fetch_add(1, Ordering::Relaxed);
                let Some(request) = requests.get(i) else { break };
                let last = next.load(Ordering::Relaxed) >= requests.len();
                let made = lane.run(views, request, stride, last);
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
        self.lanes.iter().map(|l| l.session.opening_ms()).sum()
    }

    /// Gives the sessions' memory back; the next run opens them again.
    pub fn close(&mut self) {
        for lane in &mut self.lanes {
            lane.session.close();
            lane.planes = Vec::new();
        }
    }
}

impl Lane {
    /// When the network wants more sources than there are, the best is given again.
    fn run(&mut self, views: usize, request: &Request<'_>, stride: usize, last: bool) -> Result<Made, InitError> {
        let started = Instant::now();
        let opened = self.session.opening_ms();
        let reference = request.reference;
        let k = &reference.view.intrinsics;
        let (w, h) = (k.width, k.height);
        self.planes.clear();
        push_planes(reference.image()?.as_ref(), w, h, &self.session.manifest().input, &mut self.planes);
        let mut projections = Vec::with_capacity(16 * (views - 1));
        for i in 0..views - 1 {
            let source = request.sources.get(i).or(request.sources.first()).copied().unwrap_or(reference);
            push_planes(source.image()?.as_ref(), w, h, &self.session.manifest().input, &mut self.planes);
            projections.extend(relative_projection(&reference.view, &source.view));
        }
        let k_ref = [k.fx, 0.0, k.cx - 0.5, 0.0, k.fy, k.cy - 0.5, 0.0, 0.0, 1.0];
        let inputs = [self.planes.as_slice(), &projections, &request.range, &k_ref];
        let out = if last { self.session.run((w, h), &inputs) } else { self.session.run_on((w, h), &inputs) }?;
        let (mut grid, non_finite) = DepthGrid::sampled(w as usize, h as usize, stride, &out[0].data, &out[1].data);
        let moved = if self.grows_edges {
            edges::follow_the_pictures(&mut grid, &edges::Pictures::new((w, h), &self.planes, &projections))
        } else {
            0
        };
        let run_ms = started.elapsed().as_secs_f64() * 1e3 - (self.session.opening_ms() - opened);
        Ok(Made { grid, non_finite, moved, run_ms })
    }
}
