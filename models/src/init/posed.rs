//! Depths of pictures whose poses are known: by matching, or by a user's pair network (IterMVS's signature): pictures and
//! relative projections in, depth and confidence out.
//!
//! Matching works on several pictures at once, each on one thread. A user's network, whose memory only its first run tells,
//! is opened once and has all threads.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use glam::{DMat3, DMat4, DVec3};

use crate::camera::{Intrinsics, View};
use crate::onnx::network::{LazySession, Network};
use crate::onnx::picture::push_planes;

use super::InitError;
use super::depth_frame::{DepthFrame, DepthGrid};
use super::stereo::{self, Stereo};

/// Floats per pixel of a picture that a network's session holds while it runs; IterMVS with three views takes 397.
const FLOATS_PER_PIXEL: u64 = 420;
/// What opening a session takes beside its weights: the graph's nodes and plans.
const SESSION_BYTES: u64 = 28 << 20;

/// Makes depths; what it needs lives from the first run until [`Self::close`].
#[derive(Debug)]
pub struct PosedPairs {
    sources: usize,
    lanes: Vec<Lane>,
}

/// One picture at a time.
#[derive(Debug)]
enum Lane {
    Matching(Box<Stereo>),
    Network(Box<Running>),
}

/// A network at work.
#[derive(Debug)]
struct Running {
    session: LazySession,
    planes: Vec<f32>,
    file_bytes: u64,
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

impl PosedPairs {
    /// By matching, on `threads` pictures at once.
    pub fn matching(threads: usize) -> Self {
        let lane = || Lane::Matching(Box::default());
        Self { sources: stereo::SOURCES, lanes: std::iter::repeat_with(lane).take(threads.max(1)).collect() }
    }

    /// By a network of contract `pair` with `poses = "given"` that takes `views` pictures.
    pub fn network(network: Arc<Network>, views: usize, threads: usize) -> Self {
        let file_bytes = network.file_bytes();
        let running = Running { session: LazySession::new(network, threads), planes: Vec::new(), file_bytes };
        Self { sources: views - 1, lanes: vec![Lane::Network(Box::new(running))] }
    }

    /// Source pictures per run.
    pub fn sources(&self) -> usize {
        self.sources
    }

    /// Host bytes that it takes while it runs on pictures of a number of pixels.
    pub fn planned_bytes(&self, pixels: u64) -> u64 {
        let of = |lane: &Lane| match lane {
            Lane::Matching(_) => Stereo::planned_bytes(pixels),
            Lane::Network(running) => SESSION_BYTES + 2 * running.file_bytes + pixels * FLOATS_PER_PIXEL * 4,
        };
        self.lanes.iter().map(of).sum()
    }

    /// Makes the depths of all requests, in their order, on every `stride`-th pixel.
    ///
    /// # Errors
    /// Of the first request that failed: ONNX Runtime, the contract, or the frames' file.
    pub fn run_all(&mut self, requests: &[Request<'_>], stride: usize) -> Result<Vec<Made>, InitError> {
        let next = AtomicUsize::new(0);
        let done: Mutex<Vec<(usize, Result<Made, InitError>)>> = Mutex::new(Vec::with_capacity(requests.len()));
        let sources = self.sources;
        let work = |lane: &mut Lane| {
            loop {
                let i = next.fetch_add(1, Ordering::Relaxed);
                let Some(request) = requests.get(i) else { break };
                let made = match lane {
                    Lane::Matching(stereo) => matched(stereo, request, stride),
                    Lane::Network(running) => running.run(sources, request, stride),
                };
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

    /// Milliseconds spent opening sessions so far.
    pub fn opening_ms(&self) -> f64 {
        let of = |lane: &Lane| match lane {
            Lane::Matching(_) => 0.0,
            Lane::Network(running) => running.session.opening_ms(),
        };
        self.lanes.iter().map(of).sum()
    }

    /// Gives the memory back; the next run takes it again.
    pub fn close(&mut self) {
        for lane in &mut self.lanes {
            match lane {
                Lane::Matching(stereo) => stereo.close(),
                Lane::Network(running) => {
                    running.session.close();
                    running.planes = Vec::new();
                }
            }
        }
    }
}

fn matched(stereo: &mut Stereo, request: &Request<'_>, stride: usize) -> Result<Made, InitError> {
    let started = Instant::now();
    let reference = request.reference;
    let images = request.sources.iter().map(|s| s.image()).collect::<Result<Vec<_>, _>>()?;
    let sources = request.sources.iter().zip(&images).map(|(source, image)| stereo::Source {
        image: image.as_ref(),
        projection: relative_projection(&reference.view, &source.view),
    });
    let image = reference.image()?;
    let cells = stereo.depths(image.as_ref(), &sources.collect::<Vec<_>>(), request.range);
    let size = (image.width() as usize, image.height() as usize);
    let grid = DepthGrid::of_cells(size, stride, &cells);
    Ok(Made { grid, non_finite: 0, run_ms: started.elapsed().as_secs_f64() * 1e3 })
}

impl Running {
    /// When the network wants more sources than there are, the best is given again.
    fn run(&mut self, sources: usize, request: &Request<'_>, stride: usize) -> Result<Made, InitError> {
        let started = Instant::now();
        let opened = self.session.opening_ms();
        let reference = request.reference;
        let k = &reference.view.intrinsics;
        let (w, h) = (k.width, k.height);
        self.planes.clear();
        push_planes(reference.image()?.as_ref(), w, h, &self.session.manifest().input, &mut self.planes);
        let mut projections = Vec::with_capacity(16 * sources);
        for i in 0..sources {
            let source = request.sources.get(i).or(request.sources.first()).copied().unwrap_or(reference);
            push_planes(source.image()?.as_ref(), w, h, &self.session.manifest().input, &mut self.planes);
            projections.extend(relative_projection(&reference.view, &source.view));
        }
        let k_ref = [k.fx, 0.0, k.cx - 0.5, 0.0, k.fy, k.cy - 0.5, 0.0, 0.0, 1.0];
        let inputs = [self.planes.as_slice(), &projections, &request.range, &k_ref];
        let out = self.session.run((w, h), &inputs)?;
        let (grid, non_finite) = DepthGrid::sampled(w as usize, h as usize, stride, &out[0].data, &out[1].data);
        let run_ms = started.elapsed().as_secs_f64() * 1e3 - (self.session.opening_ms() - opened);
        Ok(Made { grid, non_finite, run_ms })
    }
}
