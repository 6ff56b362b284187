//! Solving the reduced equations: dense Cholesky while they are small, conjugate gradients with block-Jacobi
//! preconditioning on the sparse blocks beyond (work grows with the number of co-visible pairs).

use super::problem::SHARED;
use super::schur::{Block, FrameVec, Reduced, SharedVec};
use nalgebra::{DMatrix, DVector, SMatrix};

/// Frames up to which the dense solve is faster (366 unknowns: 16 MFLOP).
const DENSE_FRAMES: usize = 60;
/// Conjugate-gradient steps at most; the warm-started problems here need some tens.
const MAX_CG: usize = 400;

/// A right-hand side or a solution.
#[derive(Clone)]
pub(crate) struct Step {
    pub frames: Vec<FrameVec>,
    pub shared: SharedVec,
}

impl Step {
    fn dot(&self, other: &Self) -> f64 {
        let frames: f64 = self.frames.iter().zip(&other.frames).map(|(a, b)| a.dot(b)).sum();
        frames + self.shared.dot(&other.shared)
    }

    /// self = self · scale + other · factor.
    fn mix(&mut self, scale: f64, other: &Self, factor: f64) {
        self.frames.iter_mut().zip(&other.frames).for_each(|(a, b)| *a = *a * scale + b * factor);
        self.shared = self.shared * scale + other.shared * factor;
    }
}

impl Reduced {
    /// Solves for `right`; `None` when the equations are not positive definite or a value is not finite.
    pub fn solve(&self, right: &Step) -> Option<Step> {
        let out = if self.border.len() <= DENSE_FRAMES { self.solve_dense(right)? } else { self.solve_sparse(right)? };
        let finite =
            out.frames.iter().all(|f| f.iter().all(|x| x.is_finite())) && out.shared.iter().all(|x| x.is_finite());
        finite.then_some(out)
    }

    /// Minus the gradient: the right-hand side of a Gauss–Newton step.
    pub fn downhill(&self) -> Step {
        Step { frames: self.gradient.iter().map(|g| -g).collect(), shared: -self.shared_gradient }
    }

    /// Lower triangle of the whole.
    fn dense(&self) -> DMatrix<f64> {
        let n = self.border.len();
        let mut a = DMatrix::<f64>::zeros(6 * n + SHARED, 6 * n + SHARED);
        for ((i, j), block) in self.pairs.iter().zip(&self.blocks) {
            a.fixed_view_mut::<6, 6>(*j as usize * 6, *i as usize * 6).copy_from(&block.transpose());
        }
        for (i, border) in self.border.iter().enumerate() {
            a.fixed_view_mut::<SHARED, 6>(6 * n, 6 * i).copy_from(&border.transpose());
        }
        a.fixed_view_mut::<SHARED, SHARED>(6 * n, 6 * n).copy_from(&self.shared);
        a
    }

    fn solve_dense(&self, right: &Step) -> Option<Step> {
        let n = self.border.len();
        let mut b = DVector::<f64>::zeros(6 * n + SHARED);
        for i in 0..n {
            b.fixed_rows_mut::<6>(6 * i).copy_from(&right.frames[i]);
        }
        b.fixed_rows_mut::<SHARED>(6 * n).copy_from(&right.shared);
        self.dense().cholesky()?.solve_mut(&mut b);
        Some(Step {
            frames: (0..n).map(|i| b.fixed_rows::<6>(6 * i).into_owned()).collect(),
            shared: b.fixed_rows::<SHARED>(6 * n).into_owned(),
        })
    }

    /// The inverse as a whole, six rows a frame and then those of what all share.
    pub fn inverse(&self) -> Option<DMatrix<f64>> {
        let inverse = self.dense().cholesky()?.inverse();
        inverse.iter().all(|x| x.is_finite()).then_some(inverse)
    }

    fn solve_sparse(&self, right: &Step) -> Option<Step> {
        let n = self.border.len();
        let inverses: Option<Vec<Block>> = self.blocks[..n].iter().map(|b| b.cholesky().map(|c| c.inverse())).collect();
        let inverses = inverses?;
        let shared_inverse: SMatrix<f64, SHARED, SHARED> = self.shared.cholesky()?.inverse();
        let precondition = |r: &Step| Step {
            frames: r.frames.iter().zip(&inverses).map(|(r, m)| m * r).collect(),
            shared: shared_inverse * r.shared,
        };
        let mut x = Step { frames: vec![FrameVec::zeros(); n], shared: SharedVec::zeros() };
        let mut r = right.clone();
        let mut z = precondition(&r);
        let mut p = z.clone();
        let mut rz = r.dot(&z);
        let goal = rz * 1e-16;
        for _ in 0..MAX_CG {
            if rz <= goal || rz <= 0.0 {
                break;
            }
            let ap = self.times(&p);
            let curvature = p.dot(&ap);
            if curvature.is_nan() || curvature <= 0.0 {
                return None;
            }
            let along = rz / curvature;
            x.mix(1.0, &p, along);
            r.mix(1.0, &ap, -along);
            z = precondition(&r);
            let next = r.dot(&z);
            p.mix(next / rz, &z, 1.0);
            rz = next;
        }
        Some(x)
    }

    fn times(&self, x: &Step) -> Step {
        let mut out = Step { frames: vec![FrameVec::zeros(); x.frames.len()], shared: self.shared * x.shared };
        for ((i, j), block) in self.pairs.iter().zip(&self.blocks) {
            let (i, j) = (*i as usize, *j as usize);
            out.frames[i] += block * x.frames[j];
            if i != j {
                out.frames[j] += block.transpose() * x.frames[i];
            }
        }
        for (i, border) in self.border.iter().enumerate() {
            out.frames[i] += border * x.shared;
            out.shared += border.transpose() * x.frames[i];
        }
        out
    }
}
