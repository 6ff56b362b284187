//! One key frame as the refiner keeps it: key points and quantised descriptors, never the picture itself.

use super::calibration::Calibration;
use super::grey::Grey;
use super::report::PosePrecision;
use crate::camera::{Intrinsics, Pose, PoseSigma};
use crate::frame_file::{AsBytes, FrameFile, Kept};
pub(crate) use crate::onnx::features::DESCRIPTOR;
use crate::onnx::features::Features;
use glam::DVec3;
use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::Arc;

/// `DESCRIPTOR` values per key point.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Descriptors(pub Vec<i8>);

impl Descriptors {
    /// Of key point `i`; empty where there is none.
    pub fn of(&self, i: usize) -> &[i8] {
        self.0.get(i * DESCRIPTOR..(i + 1) * DESCRIPTOR).unwrap_or_default()
    }
}

impl AsBytes for Descriptors {
    type Shape = usize;

    fn shape(&self) -> usize {
        self.0.len()
    }

    fn to_bytes(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(bytemuck::cast_slice(&self.0))
    }

    fn byte_count(length: usize) -> usize {
        length
    }

    fn from_bytes(_: usize, bytes: Vec<u8>) -> Self {
        Self(bytemuck::cast_vec(bytes))
    }
}

/// What a key frame came with.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Told {
    pub time_ns: u64,
    pub pose: Pose,
    pub sigma: PoseSigma,
}

/// What the points that a key frame sees say of it.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Known {
    /// Depth below which 1 % and above which 1 % of them lie, metres.
    pub depths: Option<(f32, f32)>,
    /// How well its pose is known, once all have been judged.
    pub precision: Option<PosePrecision>,
    /// Its place is known too badly to be one.
    pub loose: bool,
    /// It does not agree with the largest part of the scene.
    pub apart: bool,
}

/// Whether a key frame is part of the scene, as far as that has been judged.
pub(crate) fn belongs(frame: &KeyFrame) -> bool {
    frame.tied && !frame.known.loose && !frame.known.apart
}

/// A key frame and what is known about it.
pub(crate) struct KeyFrame {
    pub name: String,
    pub intrinsics: Intrinsics,
    /// The telemetry's word; of a scene that pictures alone have placed, where it was before the adjustment.
    pub prior: Pose,
    /// What it came with, whatever has become of `prior` since.
    pub told: Told,
    /// Along-track velocity at it, as far as known when it was last placed.
    pub velocity: DVec3,
    pub sigma: PoseSigma,
    /// Best estimate so far.
    pub pose: Pose,
    /// Believed rotation error of `pose` (one sigma, radians): bounds the search for matches.
    pub rotation_sigma: f64,
    /// Believed position error of `pose`, metres.
    pub position_sigma: f64,
    /// The pictures say that the prior's rotation cannot be right.
    pub rotation_refused: bool,
    /// Nothing says where it was taken: it takes part in nothing.
    pub unplaced: bool,
    /// A bundle adjustment has placed it.
    pub adjusted: bool,
    /// Enough points hold it in place.
    pub tied: bool,
    /// Quarter turns (clockwise) of the picture before features were extracted.
    pub turns: u8,
    /// Verified pairs this frame takes part in.
    pub pairs: u32,
    pub known: Known,
    /// Key points, in pixels of the picture as it is: what the lens is estimated from.
    pub seen: Vec<[f32; 2]>,
    /// Key points as a pinhole would have seen them; none while the lens bends nothing.
    pub straight: Vec<[f32; 2]>,
    pub colors: Vec<[u8; 3]>,
    /// Key points whose place photometric alignment has settled.
    pub settled: Vec<bool>,
    /// What is kept of the picture, when there was one.
    pub grey: Option<Kept<Grey>>,
    /// `DESCRIPTOR` values per key point, a unit vector times 127: a quarter of the memory of f32, and the
    /// cosine keeps three digits.
    pub descriptors: Kept<Descriptors>,
    /// Node of the first key point in the union of matches.
    pub first_node: u32,
}

impl KeyFrame {
    /// Its descriptors; none, with a word about it, where they cannot be read.
    pub fn descriptors(&self) -> Cow<'_, Descriptors> {
        self.descriptors.get().unwrap_or_else(|e| {
            tracing::warn!("{}: {e}; it matches nothing", self.name);
            Cow::Owned(Descriptors::default())
        })
    }

    /// What is kept of its picture; nothing, with a word about it, where it cannot be read.
    pub fn grey(&self) -> Option<Cow<'_, Grey>> {
        let read = self.grey.as_ref()?.get();
        read.inspect_err(|e| tracing::warn!("{}: {e}; its matches are not settled", self.name)).ok()
    }

    /// Bytes it takes of the memory.
    pub fn bytes(&self) -> usize {
        let kept = self.descriptors.bytes_in_memory() + self.grey.as_ref().map_or(0, Kept::bytes_in_memory);
        kept + self.seen.len() * 12 + self.straight.len() * 8
    }

    /// Key points as a pinhole would have seen them, pixels.
    pub fn keypoints(&self) -> &[[f32; 2]] {
        if self.straight.is_empty() { &self.seen } else { &self.straight }
    }

    /// What the picture looks like on the whole: the mean of its descriptors, of unit length.
    pub fn look(&self) -> Vec<f32> {
        let mut mean = vec![0.0f32; DESCRIPTOR];
        for d in self.descriptors().0.chunks_exact(DESCRIPTOR) {
            mean.iter_mut().zip(d).for_each(|(m, v)| *m += f32::from(*v));
        }
        let length = mean.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
        mean.iter_mut().for_each(|v| *v /= length);
        mean
    }

    /// Takes the best `max` of features found with the picture turned by `turns`; colours are the caller's.
    pub fn describe(
        &mut self,
        features: Features,
        turns: u8,
        max: usize,
        lens: &Calibration,
        file: Option<&Arc<FrameFile>>,
    ) {
        let features = spread(features, max);
        self.turns = turns;
        self.descriptors = Kept::at_best(quantise(&features.descriptors), file);
        self.settled = vec![false; features.keypoints.len()];
        self.seen = features.keypoints;
        self.straighten(lens);
    }

    /// Key points as the pinhole sees them, of those in the picture and what is known of the lens.
    pub fn straighten(&mut self, lens: &Calibration) {
        let camera = lens.camera(self.pose, &self.intrinsics);
        self.straight.clear();
        if !lens.radial.is_none() {
            self.straight.extend(self.seen.iter().map(|p| lens.radial.undistorted(&camera, *p)));
        }
    }
}

/// Unit vectors times 127, rounded; a descriptor that is not finite or zero becomes all zero and matches nothing.
pub(crate) fn quantise(descriptors: &[f32]) -> Descriptors {
    let mut out = Vec::with_capacity(descriptors.len());
    for d in descriptors.chunks_exact(DESCRIPTOR) {
        let norm = d.iter().map(|x| x * x).sum::<f32>().sqrt();
        let scale = if norm.is_finite() && norm > 1e-12 { 127.0 / norm } else { 0.0 };
        // Rounded by cutting off: `round` is a call of a library where a processor has no instruction for it.
        out.extend(d.iter().map(|x| if scale > 0.0 { (x * scale + 0.5f32.copysign(*x)) as i8 } else { 0 }));
    }
    Descriptors(out)
}

/// Key points closer than this to a better one are left out, pixels: their descriptors come from the same cells of
/// the network's map, so that they would be taken for one another.
const APART: f32 = 5.0;

/// At most `max` features, best first, none too close to a better one, all at finite places.
pub(crate) fn spread(features: Features, max: usize) -> Features {
    let mut out = Features::default();
    let mut taken: HashMap<(i32, i32), Vec<[f32; 2]>> = HashMap::new();
    for (i, p) in features.keypoints.iter().enumerate() {
        if out.keypoints.len() >= max {
            break;
        }
        if !(p[0].is_finite() && p[1].is_finite()) {
            continue;
        }
        let cell = ((p[0] / APART) as i32, (p[1] / APART) as i32);
        let near = |q: &[f32; 2]| (q[0] - p[0]).hypot(q[1] - p[1]) < APART;
        let crowded = (-1..=1)
            .any(|dy| (-1..=1).any(|dx| taken.get(&(cell.0 + dx, cell.1 + dy)).is_some_and(|c| c.iter().any(near))));
        if !crowded {
            taken.entry(cell).or_default().push(*p);
            out.keypoints.push(*p);
            out.descriptors.extend_from_slice(features.descriptor(i));
            out.scores.push(features.scores.get(i).copied().unwrap_or(0.0));
        }
    }
    out
}
