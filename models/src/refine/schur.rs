//! Normal equations with the points eliminated: the 3×3 block of every point is inverted on the spot, so that
//! only frames and shared parameters remain. Blocks exist only for pairs of frames that see a common point.

use super::calibration::LENS;
use super::problem::{FOCAL, Loss, Problem, SHARED};
use super::so3::skew;
use crate::camera::Pinhole;
use glam::DVec3;
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use rayon::prelude::*;
use std::sync::Arc;

pub(crate) type Block = SMatrix<f64, 6, 6>;
pub(crate) type Border = SMatrix<f64, 6, SHARED>;
pub(crate) type FrameVec = SVector<f64, 6>;
pub(crate) type SharedVec = SVector<f64, SHARED>;

/// Parts of the points summed side by side; fixed, so that the sum has one order on every machine.
const PARTS: usize = 4;

/// Which block is that of two frames; its room grows with the pairs that see a common point, not with the square of the frames.
pub(crate) struct Index {
    /// Of each frame those of its own number and above, ascending, with their blocks.
    rows: Vec<Vec<(u32, u32)>>,
}

impl Index {
    /// Notes that the block of (i, j), i ≤ j, is `slot`; false when there is one already.
    fn enter(&mut self, i: u32, j: u32, slot: u32) -> bool {
        let row = &mut self.rows[i as usize];
        match row.binary_search_by_key(&j, |b| b.0) {
            Ok(_) => false,
            Err(at) => {
                row.insert(at, (j, slot));
                true
            }
        }
    }

    fn of(&self, i: u32, j: u32) -> Option<u32> {
        let row = self.rows.get(i as usize)?;
        row.binary_search_by_key(&j, |b| b.0).ok().map(|at| row[at].1)
    }
}

/// `[frames, border; borderᵀ, shared] · step = −gradient`, symmetric.
#[derive(Clone)]
pub(crate) struct Reduced {
    index: Arc<Index>,
    pub pairs: Vec<(u32, u32)>,
    pub blocks: Vec<Block>,
    pub border: Vec<Border>,
    pub shared: SMatrix<f64, SHARED, SHARED>,
    pub gradient: Vec<FrameVec>,
    pub shared_gradient: SharedVec,
}

impl Reduced {
    /// Empty equations with the structure of `problem`: diagonal blocks first, then pairs with common points.
    pub fn new(problem: &Problem) -> Self {
        let n = problem.moving;
        let mut index = Index { rows: (0..n as u32).map(|i| vec![(i, i)]).collect() };
        let mut pairs: Vec<(u32, u32)> = (0..n as u32).map(|i| (i, i)).collect();
        for p in 0..problem.points.len() {
            let seen = problem.sightings(p);
            for (k, a) in seen.iter().enumerate() {
                for b in &seen[..k] {
                    let (i, j) = (a.camera.min(b.camera), a.camera.max(b.camera));
                    if (j as usize) < n && index.enter(i, j, pairs.len() as u32) {
                        pairs.push((i, j));
                    }
                }
            }
        }
        Self {
            index: Arc::new(index),
            blocks: vec![Block::zeros(); pairs.len()],
            pairs,
            border: vec![Border::zeros(); n],
            shared: SMatrix::zeros(),
            gradient: vec![FrameVec::zeros(); n],
            shared_gradient: SharedVec::zeros(),
        }
    }

    /// Linearises `problem` where it stands, with Levenberg–Marquardt damping `lambda` on every diagonal.
    pub fn fill(&mut self, problem: &Problem, loss: Loss, lambda: f64) {
        let cameras: Vec<Pinhole> = (0..problem.poses.len()).map(|i| problem.camera(i)).collect();
        self.clear();
        let n = problem.points.len();
        let parts: Vec<(Self, Vec<Block>)> = (0..PARTS)
            .into_par_iter()
            .map(|part| {
                let mut sum = self.clone();
                let mut undamped = vec![Block::zeros(); problem.moving];
                let mut rows = Vec::new();
                for i in n * part / PARTS..n * (part + 1) / PARTS {
                    sum.eliminate(problem, &cameras, i, loss, lambda, &mut rows, &mut undamped);
                }
                (sum, undamped)
            })
            .collect();
        let mut diagonal = vec![Block::zeros(); problem.moving];
        for (part, undamped) in &parts {
            self.blocks.iter_mut().zip(&part.blocks).for_each(|(a, b)| *a += b);
            self.border.iter_mut().zip(&part.border).for_each(|(a, b)| *a += b);
            self.gradient.iter_mut().zip(&part.gradient).for_each(|(a, b)| *a += b);
            diagonal.iter_mut().zip(undamped).for_each(|(a, b)| *a += b);
            self.shared += part.shared;
            self.shared_gradient += part.shared_gradient;
        }
        self.add_priors(problem, &mut diagonal);
        for (i, d) in diagonal.iter().enumerate() {
            self.blocks[i] += d;
            for k in 0..6 {
                self.blocks[i][(k, k)] += lambda * d[(k, k)] + 1e-12;
            }
        }
        for k in 0..SHARED {
            self.shared[(k, k)] += lambda * self.shared[(k, k)].max(0.0);
            if !problem.free[k] {
                self.pin(k);
            }
        }
    }

    fn clear(&mut self) {
        self.blocks.fill(Block::zeros());
        self.border.fill(Border::zeros());
        self.gradient.fill(FrameVec::zeros());
        self.shared = SMatrix::zeros();
        self.shared_gradient = SharedVec::zeros();
    }

    /// Takes shared parameter `k` out: its step becomes zero.
    fn pin(&mut self, k: usize) {
        self.border.iter_mut().for_each(|b| b.set_column(k, &FrameVec::zeros()));
        self.shared.row_mut(k).fill(0.0);
        self.shared.column_mut(k).fill(0.0);
        self.shared[(k, k)] = 1.0;
        self.shared_gradient[k] = 0.0;
    }

    fn add_priors(&mut self, problem: &Problem, diagonal: &mut [Block]) {
        for (i, diagonal) in diagonal.iter_mut().enumerate() {
            for (r, by_pose, by_shared, w) in problem.prior_rows(i).rows {
                let (jp, js) = (FrameVec::from(by_pose), SharedVec::from(by_shared));
                *diagonal += jp * jp.transpose() * w;
                self.border[i] += jp * js.transpose() * w;
                self.shared += js * js.transpose() * w;
                self.gradient[i] += jp * (r * w);
                self.shared_gradient += js * (r * w);
            }
        }
        for (k, r) in problem.shared_residuals().into_iter().enumerate() {
            let w = problem.shared_weight[k];
            self.shared[(k, k)] += w * w;
            self.shared_gradient[k] += w * r;
        }
    }

    #[allow(clippy::too_many_arguments)] // scratch buffers are passed to keep the loop free of allocation
    fn eliminate(
        &mut self,
        problem: &Problem,
        cameras: &[Pinhole],
        point: usize,
        loss: Loss,
        lambda: f64,
        rows: &mut Vec<Row>,
        undamped: &mut [Block],
    ) {
        let eq = PointEquation::new(problem, cameras, point, loss, lambda, rows);
        let Some(inverse) = eq.inverse else { return };
        let moves = |row: &Row| (row.camera as usize) < problem.moving;
        let to_lens = inverse * eq.by_lens;
        for (k, row) in rows.iter().enumerate() {
            let mut corner = self.shared.fixed_view_mut::<LENS, LENS>(FOCAL, FOCAL);
            corner += row.jl.transpose() * row.jl * row.weight;
            let mut gradient = self.shared_gradient.fixed_rows_mut::<LENS>(FOCAL);
            gradient += row.jl.transpose() * row.r * row.weight;
            if !moves(row) {
                continue;
            }
            let i = row.camera as usize;
            undamped[i] += row.jc.transpose() * row.jc * row.weight;
            let t = row.cross * inverse;
            self.gradient[i] += row.jc.transpose() * row.r * row.weight - t * eq.gradient;
            let lens = row.jc.transpose() * row.jl * row.weight - row.cross * to_lens;
            let mut columns = self.border[i].fixed_columns_mut::<LENS>(FOCAL);
            columns += lens;
            for other in rows[..=k].iter().filter(|other| moves(other)) {
                let (i, j) = (row.camera.min(other.camera), row.camera.max(other.camera));
                let product = t * other.cross.transpose();
                let Some(slot) = self.index.of(i, j) else { continue };
                let block = &mut self.blocks[slot as usize];
                if row.camera <= other.camera {
                    *block -= product;
                } else {
                    *block -= product.transpose();
                }
            }
        }
        let mut corner = self.shared.fixed_view_mut::<LENS, LENS>(FOCAL, FOCAL);
        corner -= eq.by_lens.transpose() * to_lens;
        let mut gradient = self.shared_gradient.fixed_rows_mut::<LENS>(FOCAL);
        gradient -= to_lens.transpose() * eq.gradient;
    }
}

/// One observation's derivatives.
pub(crate) struct Row {
    camera: u32,
    weight: f64,
    r: SVector<f64, 2>,
    jc: SMatrix<f64, 2, 6>,
    /// By the lens.
    jl: SMatrix<f64, 2, LENS>,
    /// weight · Jcᵀ · Jx
    cross: SMatrix<f64, 6, 3>,
}

/// One point's 3×3 block, inverted, and what couples it to the rest.
struct PointEquation {
    /// `None` when no observation constrains the point.
    inverse: Option<Matrix3<f64>>,
    gradient: Vector3<f64>,
    by_lens: SMatrix<f64, 3, LENS>,
}

impl PointEquation {
    fn new(problem: &Problem, cameras: &[Pinhole], point: usize, loss: Loss, lambda: f64, rows: &mut Vec<Row>) -> Self {
        rows.clear();
        let world = problem.points[point];
        let per_px = 1.0 / problem.pixel_sigma;
        let mut v = Matrix3::zeros();
        let (mut gradient, mut by_lens) = (Vector3::zeros(), SMatrix::<f64, 3, LENS>::zeros());
        let lens = problem.shared.lens;
        for o in problem.sightings(point) {
            let camera = &cameras[o.camera as usize];
            let p = camera.local(world);
            let Some(r) = problem.residual(camera, world, o) else { continue };
            let r = r * per_px;
            let weight = loss.at(r.length_squared()).1;
            let (du, dv) = lens.radial.by_local(camera, p);
            let (du, dv) = (du * per_px, dv * per_px);
            // p turns by p × δ when the camera turns by δ about its own axes, and moves against its centre.
            let turn = skew(p).transpose();
            let (tu, tv) = (turn * du, turn * dv);
            let (xu, xv) = (camera.pose.rotation * du, camera.pose.rotation * dv);
            let jc = SMatrix::<f64, 2, 6>::from_row_slice(&[
                tu.x, tu.y, tu.z, -xu.x, -xu.y, -xu.z, tv.x, tv.y, tv.z, -xv.x, -xv.y, -xv.z,
            ]);
            let jx = SMatrix::<f64, 2, 3>::from_row_slice(&[xu.x, xu.y, xu.z, xv.x, xv.y, xv.z]);
            let by = lens.by_lens(camera, p).map(|d| d * per_px);
            let jl = SMatrix::<f64, 2, LENS>::from_fn(|row, k| by[k][row]);
            let r = SVector::<f64, 2>::new(r.x, r.y);
            v += jx.transpose() * jx * weight;
            gradient += jx.transpose() * r * weight;
            by_lens += jx.transpose() * jl * weight;
            rows.push(Row { camera: o.camera, weight, r, jc, jl, cross: jc.transpose() * jx * weight });
        }
        if let Some((off, per_m, (_, weight))) = problem.anchor_of(point) {
            for k in 0..3 {
                v[(k, k)] += per_m[k] * per_m[k] * weight;
                gradient[k] += per_m[k] * off[k] * weight;
            }
        }
        for k in 0..3 {
            v[(k, k)] += lambda * v[(k, k)] + 1e-12;
        }
        Self { inverse: v.cholesky().map(|c| c.inverse()), gradient, by_lens }
    }
}

/// Steps of the points that belong to the given steps of frames and of what all share.
pub(crate) fn point_steps(
    problem: &Problem,
    loss: Loss,
    lambda: f64,
    frames: &[FrameVec],
    shared: &SharedVec,
) -> Vec<DVec3> {
    let lens: SVector<f64, LENS> = shared.fixed_rows::<LENS>(FOCAL).into_owned();
    let cameras: Vec<Pinhole> = (0..problem.poses.len()).map(|i| problem.camera(i)).collect();
    (0..problem.points.len())
        .into_par_iter()
        .with_min_len(256)
        .map_init(Vec::new, |rows, i| {
            let eq = PointEquation::new(problem, &cameras, i, loss, lambda, rows);
            let Some(inverse) = eq.inverse else { return DVec3::ZERO };
            let mut g = eq.gradient + eq.by_lens * lens;
            for row in rows.iter() {
                // What stands still takes no step.
                g += frames.get(row.camera as usize).map_or_else(Vector3::zeros, |step| row.cross.transpose() * step);
            }
            let d = -(inverse * g);
            DVec3::new(d.x, d.y, d.z)
        })
        .collect()
}
