//! Networks that know no poses (Splatt3R's signature): every pair gives two pointmaps and Gaussian heads in the first
//! camera's frame, at a scale of its own. Global alignment turns them into one χ per picture in the aircraft's frame;
//! of the heads, each picture keeps those of its most confident pair, so that memory does not grow with the pairs.

use std::sync::Arc;

use glam::{Mat3, Quat, Vec3};

use config::init::InitSettings;

use super::InitError;
use crate::align::graph::{Edge, PointMap};
use crate::align::icp::icp;
use crate::align::solve::{Alignment, align};
use crate::camera::{Pose, Unprojector, View};
use crate::cloud::SH_C0;
use crate::onnx::manifest::{OpacityUnit, PairSettings, QuaternionOrder, ScaleUnit};
use crate::onnx::network::{LazySession, Network};
use crate::onnx::picture::push_planes;
use crate::onnx::session::Tensor;

use super::depth_frame::{DepthFrame, DepthGrid};

/// Points that ICP compares, at most.
const ICP_POINTS: usize = 1500;
/// sˡ outside these bounds is noise at depth edges.
const LOCAL: [f32; 2] = [0.1, 10.0];

/// Gaussian heads of one picture on the depth grid, in the frame of their pair's first camera.
#[derive(Clone, Debug)]
pub struct Heads {
    /// Which edge they come from.
    pub edge: usize,
    points: Vec<Vec3>,
    scales: Vec<Vec3>,
    rotations: Vec<Quat>,
    /// Colour the network adds to (residual) or puts in place of the picture's.
    colors: Vec<Vec3>,
    opacities: Vec<f32>,
    /// Sum of confidence.
    trust: f64,
}

/// Covariance, colour and opacity that a network gave a sample, ready for the merge.
#[derive(Clone, Debug)]
pub struct Appearance {
    /// World, m².
    pub covariances: Vec<Mat3>,
    /// Linear colour, or the difference to the picture's.
    pub colors: Vec<Vec3>,
    /// Whether `colors` are differences.
    pub residual: bool,
    /// 0…1.
    pub opacities: Vec<f32>,
}

/// An unposed pair network.
#[derive(Debug)]
pub struct PairNetwork {
    session: LazySession,
    pair: PairSettings,
    file_bytes: u64,
}

impl PairNetwork {
    /// Of a network whose `pair` table says `poses = "none"`.
    pub fn new(network: Arc<Network>, pair: PairSettings, threads: usize) -> Self {
        Self { file_bytes: network.file_bytes(), session: LazySession::new(network, threads), pair }
    }

    /// Its conventions.
    pub fn pair(&self) -> &PairSettings {
        &self.pair
    }

    /// Host bytes of its session while it runs: weights as the runtime keeps and packs them, and the tensors of the
    /// contract alone. A network's inner tensors cannot be known before it runs.
    pub fn planned_bytes(&self, pixels: u64) -> u64 {
        let degree = u64::from(self.pair.sh_degree) + 1;
        let floats = 2 * (3 + 3 + 1 + 3 + 4 + 3 * degree * degree + 1);
        2 * self.file_bytes + 2 * pixels * floats * 4
    }

    /// Gives the session's memory back.
    pub fn close(&mut self) {
        self.session.close();
    }

    /// Looks at a pair; `stride` thins the outputs to the depth grid. Returns the edge and both pictures' heads.
    ///
    /// # Errors
    /// ONNX Runtime or the contract fails.
    pub fn run(
        &mut self,
        frames: &[DepthFrame],
        pair: [usize; 2],
        stride: usize,
        edge: usize,
    ) -> Result<(Edge, [Heads; 2]), InitError> {
        let [first, second] = pair.map(|i| &frames[i]);
        let images = [first.image()?, second.image()?];
        let (w, h) = images[0].dimensions();
        let mut planes = [Vec::new(), Vec::new()];
        push_planes(images[0].as_ref(), w, h, &self.session.manifest().input, &mut planes[0]);
        push_planes(images[1].as_ref(), w, h, &self.session.manifest().input, &mut planes[1]);
        let out = self.session.run((w, h), &[&planes[0], &planes[1]])?;
        let thin = Thinning { pair: &self.pair, size: (w as usize, h as usize), stride, edge };
        let (map1, heads1) = thin.outputs(&out[..6], None);
        // The second pointmap of a network that states metres may be in its own camera's frame.
        let own_frame = (!self.pair.first_camera_frame).then(|| relative(&first.view.pose, &second.view.pose));
        let (map2, heads2) = thin.outputs(&out[6..], own_frame);
        Ok((Edge { first: pair[0], second: pair[1], maps: [map1, map2] }, [heads1, heads2]))
    }
}

/// Second camera → first camera: rotation, translation in metres.
fn relative(first: &Pose, second: &Pose) -> (Quat, Vec3) {
    let to_first = first.rotation.conjugate();
    ((to_first * second.rotation).as_quat(), (to_first * (second.center - first.center)).as_vec3())
}

/// From a network's full maps to the depth grid.
struct Thinning<'a> {
    pair: &'a PairSettings,
    size: (usize, usize),
    stride: usize,
    edge: usize,
}

impl Thinning<'_> {
    /// Pointmap and heads of one picture, moved by `motion` into the first camera's frame.
    fn outputs(&self, out: &[Tensor], motion: Option<(Quat, Vec3)>) -> (PointMap, Heads) {
        let (&Self { pair, size: (w, h), stride, edge }, (turn, shift)) =
            (self, motion.unwrap_or((Quat::IDENTITY, Vec3::ZERO)));
        let (gw, gh) = ((w / stride).max(1), (h / stride).max(1));
        let n = gw * gh;
        let mut map =
            PointMap { width: gw, height: gh, points: Vec::with_capacity(n), confidence: Vec::with_capacity(n) };
        let mut heads = Heads {
            edge,
            points: Vec::new(),
            scales: Vec::with_capacity(n),
            rotations: Vec::with_capacity(n),
            colors: Vec::with_capacity(n),
            opacities: Vec::with_capacity(n),
            trust: 0.0,
        };
        let d = usize::from(pair.sh_degree + 1).pow(2);
        for k in 0..n {
            let (i, j) = ((k % gw * stride + stride / 2).min(w - 1), (k / gw * stride + stride / 2).min(h - 1));
            let at = j * w + i;
            let three = |t: &Tensor| Vec3::from_slice(&t.data[3 * at..3 * at + 3]);
            map.points.push(turn * three(&out[0]) + shift);
            map.confidence.push((out[1].data[at] - pair.confidence_offset).max(0.0));
            let scale = three(&out[2]);
            heads.scales.push(if pair.scales == ScaleUnit::Log { scale.exp() } else { scale });
            let q: [f32; 4] = [0, 1, 2, 3].map(|c| out[3].data[4 * at + c]);
            let q = match pair.quaternion {
                QuaternionOrder::Xyzw => Quat::from_array(q),
                QuaternionOrder::Wxyz => Quat::from_xyzw(q[1], q[2], q[3], q[0]),
            };
            heads.rotations.push(turn * if q.length_squared() > 1e-12 { q.normalize() } else { Quat::IDENTITY });
            let dc = Vec3::new(out[4].data[at * 3 * d], out[4].data[at * 3 * d + d], out[4].data[at * 3 * d + 2 * d]);
            heads.colors.push(dc * SH_C0 + if pair.sh_residual { 0.0 } else { 0.5 });
            let o = out[5].data[at];
            heads.opacities.push(if pair.opacity == OpacityUnit::Logit { 1.0 / (1.0 + (-o).exp()) } else { o });
        }
        heads.points.clone_from(&map.points);
        heads.trust = map.confidence.iter().filter(|c| c.is_finite()).map(|c| f64::from(*c)).sum();
        (map, heads)
    }
}

/// Host bytes of the pairs' pointmaps, the pictures' heads and the global alignment, beside the networks: `samples` is
/// the number of samples of a picture's grid.
pub fn planned_bytes(pictures: u64, edges: u64, samples: u64) -> u64 {
    let per_sample = size_of::<Vec3>() as u64;
    let map = per_sample + 4;
    // Points, scales, colours; rotation and opacity.
    let heads = 3 * per_sample + 16 + 4;
    let appearance = size_of::<Mat3>() as u64 + per_sample + 4;
    // χ twice (aligned, as a grid), the world's points before and after.
    let pointmaps = 2 * 8 + 2 * per_sample;
    edges * 2 * samples * map
        + (pictures + 2) * samples * (heads + appearance + pointmaps)
        + crate::align::solve::planned_bytes(pictures, edges)
}

/// Keeps the more trusted heads of a picture.
pub fn keep_better(slot: &mut Option<Heads>, new: Heads) {
    if slot.as_ref().is_none_or(|old| new.trust > old.trust) {
        *slot = Some(new);
    }
}

/// The camera of a depth grid: one pixel per sample.
pub fn grid_view(view: &View, stride: usize) -> View {
    let k = view.intrinsics;
    let s = stride as f32;
    let center = |c: f32| (c - (stride / 2) as f32 - 0.5) / s + 0.5;
    let intrinsics = crate::camera::Intrinsics {
        width: (k.width / stride as u32).max(1),
        height: (k.height / stride as u32).max(1),
        fx: k.fx / s,
        fy: k.fy / s,
        cx: center(k.cx),
        cy: center(k.cy),
    };
    View { intrinsics, pose: view.pose }
}

/// Aligns all edges and writes χ into the frames' depth grids; returns the alignment.
///
/// # Errors
/// Writing to the frames' file fails.
pub fn align_frames(frames: &mut [DepthFrame], edges: &[Edge], settings: &InitSettings) -> std::io::Result<Alignment> {
    let stride = settings.stride as usize;
    let views: Vec<View> = frames.iter().map(|f| grid_view(&f.view, stride)).collect();
    let alignment = align(&views, edges, settings.align_steps);
    for (frame, map) in frames.iter_mut().zip(&alignment.maps) {
        let grid = map.as_ref().map(|m| DepthGrid {
            width: m.width,
            height: m.height,
            stride,
            depth: m.depth.clone(),
            // From 0…∞ to 0…1.
            confidence: m.confidence.iter().map(|c| c / (1.0 + c)).collect(),
        });
        frame.set_depth(grid)?;
    }
    Ok(alignment)
}

/// Σ of a picture's heads in the world: sᵍ from ICP between the original and the aligned points, sˡ from the distance to the
/// neighbours before and after. `first` is the camera of [`Heads::edge`]'s first picture.
pub fn appearance(
    heads: &Heads,
    (view, grid): (&View, &DepthGrid),
    first: &View,
    alignment: &Alignment,
    settings: &InitSettings,
    residual: bool,
) -> Option<Appearance> {
    let sigma = alignment.sigma.get(heads.edge).copied().flatten()? as f32;
    let turn = first.pose.rotation.normalize().as_quat();
    let unproject = Unprojector::new(view);
    let aligned: Vec<Vec3> = (0..grid.depth.len())
        .map(|at| {
            let (x, y) = grid.pixel(at % grid.width, at / grid.width);
            if grid.confidence[at] > 0.0 { unproject.at(x, y, grid.depth[at]) } else { Vec3::NAN }
        })
        .collect();
    let original: Vec<Vec3> = heads.points.iter().map(|p| turn * *p).collect();
    let global = if settings.global_scale { icp_scale(&original, &aligned).unwrap_or(sigma) } else { 1.0 };
    let covariances = (0..aligned.len())
        .map(|at| {
            let local = if settings.local_scale {
                let (before, after) = (spacing(&original, grid, at), spacing(&aligned, grid, at));
                let ratio = after / (before * global);
                if ratio.is_finite() { ratio.clamp(LOCAL[0], LOCAL[1]) } else { 1.0 }
            } else {
                1.0
            };
            let r = Mat3::from_quat(turn * heads.rotations[at]);
            let s = heads.scales[at] * (global * local);
            r * Mat3::from_diagonal(s * s) * r.transpose()
        })
        .collect();
    Some(Appearance { covariances, colors: heads.colors.clone(), residual, opacities: heads.opacities.clone() })
}

/// sᵍ.
fn icp_scale(original: &[Vec3], aligned: &[Vec3]) -> Option<f32> {
    let step = original.len().div_ceil(ICP_POINTS).max(1);
    let chosen: Vec<usize> = (0..original.len()).step_by(step).filter(|&i| aligned[i].is_finite()).collect();
    let pick = |from: &[Vec3]| chosen.iter().map(|&i| from[i]).collect::<Vec<_>>();
    icp(&pick(original), &pick(aligned)).ok().map(|r| r.similarity.scale as f32)
}

/// Mean distance to the right and lower (else left and upper) neighbours.
fn spacing(points: &[Vec3], grid: &DepthGrid, at: usize) -> f32 {
    let (i, j) = (at % grid.width, at / grid.width);
    let across = if i + 1 < grid.width { at + 1 } else { at.saturating_sub(1) };
    let down = if j + 1 < grid.height { at + grid.width } else { at.saturating_sub(grid.width) };
    0.5 * (points[at].distance(points[across]) + points[at].distance(points[down]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use glam::{DQuat, DVec3};

    const W: usize = 32;
    const H: usize = 24;

    /// Metric pointmaps of the plane z = 0, each in its own camera's frame.
    fn own_frame_map(view: &View) -> Vec<Tensor> {
        let camera = crate::camera::Pinhole::from(view);
        let n = W * H;
        let points = (0..n).flat_map(|at| {
            let ray = camera.ray([(at % W) as f32 + 0.5, (at / W) as f32 + 0.5]);
            let depth = view.pose.center.z / -(view.pose.rotation * ray).z;
            (ray * depth).as_vec3().to_array()
        });
        let tensor = |channels: usize, data: Vec<f32>| Tensor { shape: vec![1, H, W, channels], data };
        vec![
            tensor(3, points.collect()),
            tensor(1, vec![1.0; n]),
            tensor(3, vec![0.1; 3 * n]),
            tensor(4, [0.0, 0.0, 0.0, 1.0].repeat(n)),
            tensor(3, vec![0.0; 3 * n]),
            tensor(1, vec![0.9; n]),
        ]
    }

    #[test]
    fn a_second_pointmap_in_its_own_cameras_frame_is_turned_and_moved_into_the_firsts() {
        let view = |x: f64, y: f64, heading: f64, tilt: f64| {
            let intrinsics = Intrinsics { width: W as u32, height: H as u32, fx: 24.0, fy: 24.0, cx: 16.0, cy: 12.0 };
            let down = DQuat::from_rotation_x(std::f64::consts::PI - tilt);
            let rotation = DQuat::from_rotation_z(heading) * down;
            View { intrinsics, pose: Pose { rotation, center: DVec3::new(x, y, 60.0) } }
        };
        let views = [view(0.0, 0.0, 0.3, 0.0), view(11.0, -5.0, -0.4, 0.1)];
        let text =
            "name='n'\ncontract='pair'\nfile='n'\nlicence='x'\n[input]\nrange=[0,1]\n[pair]\nposes='none'\nviews=2\n";
        let text = format!("{text}metric=true\nfirst_camera_frame=false\n");
        let pair = crate::onnx::manifest::Manifest::parse(&text, "test").unwrap().pair.unwrap();
        let thin = Thinning { pair: &pair, size: (W, H), stride: 1, edge: 0 };
        let (map1, _) = thin.outputs(&own_frame_map(&views[0]), None);
        let (map2, _) = thin.outputs(&own_frame_map(&views[1]), Some(relative(&views[0].pose, &views[1].pose)));
        let first = &views[0].pose;
        for p in map1.points.iter().chain(&map2.points) {
            let world = first.rotation * p.as_dvec3() + first.center;
            assert!(world.z.abs() < 1e-3, "the plane z = 0 came out at {world}");
        }
        // Only turned, not moved, the second map would contradict the first by the whole baseline.
        let edge = Edge { first: 0, second: 1, maps: [map1, map2] };
        let aligned = align(&views, &[edge], 100);
        assert!((aligned.sigma[0].unwrap() - 1.0).abs() < 1e-3, "{:?}", aligned.sigma);
    }
}
