//! One key frame as the refiner keeps it: key points and quantised descriptors, never the picture itself.

use super::grey::Grey;
use super::radial::Radial;
use crate::camera::{Intrinsics, Pinhole, Pose, PoseSigma};
pub(crate) use crate::onnx::features::DESCRIPTOR;
use crate::onnx::features::Features;
use std::collections::HashMap;

/// A key frame and what is known about it.
pub(crate) struct KeyFrame {
    pub name: String,
    pub time_ns: u64,
    pub intrinsics: Intrinsics,
    /// The telemetry's word, never changed.
    pub prior: Pose,
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
    /// Depth below which 1 % and above which 1 % of the frame's points lie, metres.
    pub depths: Option<(f32, f32)>,
    /// Pixels of the picture as a pinhole would have taken it.
    pub keypoints: Vec<[f32; 2]>,
    /// Pixels of the picture as it is: what the lens is estimated from.
    pub seen: Vec<[f32; 2]>,
    pub colors: Vec<[u8; 3]>,
    /// Key points whose place photometric alignment has settled.
    pub settled: Vec<bool>,
    /// What is kept of the picture, when there was one.
    pub grey: Option<Grey>,
    /// `DESCRIPTOR` values per key point, a unit vector times 127: a quarter of the memory of f32, and the
    /// cosine keeps three digits.
    pub descriptors: Vec<i8>,
    /// Node of the first key point in the union of matches.
    pub first_node: u32,
}

impl KeyFrame {
    pub fn descriptor(&self, i: usize) -> &[i8] {
        &self.descriptors[i * DESCRIPTOR..(i + 1) * DESCRIPTOR]
    }

    /// What the picture looks like on the whole: the mean of its descriptors, of unit length.
    pub fn look(&self) -> Vec<f32> {
        let mut mean = vec![0.0f32; DESCRIPTOR];
        for d in self.descriptors.chunks_exact(DESCRIPTOR) {
            mean.iter_mut().zip(d).for_each(|(m, v)| *m += f32::from(*v));
        }
        let length = mean.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
        mean.iter_mut().for_each(|v| *v /= length);
        mean
    }

    /// Takes the best `max` of features found with the picture turned by `turns`; colours are the caller's.
    pub fn describe(&mut self, features: Features, turns: u8, max: usize, lens: (f64, &Radial)) {
        let features = spread(features, max);
        self.turns = turns;
        self.descriptors = quantise(&features.descriptors);
        self.settled = vec![false; features.keypoints.len()];
        self.seen = features.keypoints;
        self.straighten(lens.0, lens.1);
    }

    /// Key points as the pinhole sees them, of those in the picture and what is known of the lens.
    pub fn straighten(&mut self, focal_scale: f64, radial: &Radial) {
        let camera = Pinhole::new(self.pose, &self.intrinsics, focal_scale);
        self.keypoints.clear();
        self.keypoints.extend(self.seen.iter().map(|p| radial.undistorted(&camera, *p)));
    }
}

/// Unit vectors times 127, rounded; a descriptor that is not finite or zero becomes all zero and matches nothing.
pub(crate) fn quantise(descriptors: &[f32]) -> Vec<i8> {
    let mut out = Vec::with_capacity(descriptors.len());
    for d in descriptors.chunks_exact(DESCRIPTOR) {
        let norm = d.iter().map(|x| x * x).sum::<f32>().sqrt();
        let scale = if norm.is_finite() && norm > 1e-12 { 127.0 / norm } else { 0.0 };
        out.extend(d.iter().map(|x| if scale > 0.0 { (x * scale).round() as i8 } else { 0 }));
    }
    out
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
