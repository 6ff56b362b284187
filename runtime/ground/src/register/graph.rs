//! The pose graph of all models: where each lies so that neighbours agree as well as they can, and none leaves where its
//! telemetry puts it without need.
//!
//! A model's correction is position, heading, tilt and scale, about the middle of its ground. An edge is
//! six places that two models show ([`Link`]). One false edge must not bend the scene: edges are weighed by Geman and McClure's
//! function, whose width shrinks from where every edge counts to where only those that agree do (graduated non-convexity, Yang
//! et al. 2020). The linear systems are solved by conjugate gradients, block by block: time and memory grow as the edges do.
//!
//! Whoever joins brings its own telemetry's error, and over all models together it would move everybody by some of it. What was settled
//! before stays where it was, wherever no two neighbours are thereby farther apart than they need be.

use glam::{DQuat, DVec3};
use models::align::similarity::Similarity;

use crate::hold::STAYS_M;

/// What telemetry is worth, one standard deviation: position, tilt and heading.
/// Position as in [`config`]'s GPS priors without RTK.
const POSITION_M: f64 = 3.0;
pub(super) const TILT_RAD: f64 = 0.017;
const HEADING_RAD: f64 = 0.05;
/// Telemetry is never so far off: an edge that says so is set aside at once, metres.
const MOST_APART_M: f64 = 10_000.0;
/// The width of the weighing shrinks by this factor (Yang et al. 2020).
const SHRINK: f64 = 1.4;
/// Steps of Gauss and Newton after the last change of the weights; angles are small.
const LAST_STEPS: usize = 3;
/// Conjugate gradients end at this share of the first residual, or after so many rounds.
const TOLERANCE: f64 = 1e-9;
const MOST_ROUNDS: usize = 1000;
/// An edge counted less than this is set aside.
const SET_ASIDE: f64 = 0.25;
/// What an earlier settlement is worth where it is held, one standard deviation over the ground of a model, metres: a tenth of an edge.
const HELD_M: f64 = 0.005;

/// One model.
#[derive(Clone, Copy, Debug)]
pub struct Node {
    /// About what it turns.
    pub middle: DVec3,
    /// What its size is known to from telemetry, one standard deviation, as a share.
    pub scale_sigma: f64,
    /// How far its ground reaches from there, metres.
    pub reach_m: f64,
    /// What it was corrected by before, if it was.
    pub earlier: Option<Similarity>,
}

/// What two models show in common: places as the first has them and as the second has them.
#[derive(Clone, Copy, Debug)]
pub struct Link {
    /// The first model.
    pub a: usize,
    /// The second.
    pub b: usize,
    /// Six places, as each of both has them.
    pub places: [(DVec3, DVec3); 6],
    /// What their common place is known to, metres.
    pub sigma_m: f64,
    /// Farther apart than this they are not the same places, metres.
    pub limit_m: f64,
}

/// Where everything goes.
#[derive(Clone, Debug)]
pub struct Settled {
    /// Per node.
    pub corrections: Vec<Similarity>,
    /// Per link: whether it counts.
    pub holds: Vec<bool>,
    /// Per link: root mean square distance of its places, metres.
    apart_m: Vec<f64>,
}

type Block = [f64; 7];

/// The state of one node: shift, turn, logarithm of the scale.
#[derive(Clone, Copy)]
struct State {
    shift: DVec3,
    turn: DQuat,
    log_scale: f64,
}

impl State {
    const START: Self = Self { shift: DVec3::ZERO, turn: DQuat::IDENTITY, log_scale: 0.0 };

    fn of(similarity: &Similarity, node: &Node) -> Self {
        let Similarity { scale, rotation, .. } = *similarity;
        Self { shift: similarity.apply(node.middle) - node.middle, turn: rotation.normalize(), log_scale: scale.ln() }
    }

    fn lever(&self, node: &Node, p: DVec3) -> DVec3 {
        self.log_scale.exp() * (self.turn * (p - node.middle))
    }

    fn step(&mut self, by: &Block) {
        self.shift += DVec3::new(by[0], by[1], by[2]);
        self.turn = (DQuat::from_scaled_axis(DVec3::new(by[3], by[4], by[5])) * self.turn).normalize();
        self.log_scale += by[6];
    }

    fn similarity(&self, node: &Node) -> Similarity {
        let (scale, rotation) = (self.log_scale.exp(), self.turn);
        Similarity { scale, rotation, translation: node.middle + self.shift - scale * (rotation * node.middle) }
    }
}

/// What is known of a node beside its links.
struct Prior {
    at: State,
    /// 1/σ² of each number of a state.
    per: Block,
}

impl Prior {
    fn of(node: &Node, is_held: bool) -> Self {
        let per = |sigma: f64| 1.0 / (sigma * sigma);
        match node.earlier.filter(|_| is_held) {
            Some(earlier) => {
                let (p, t) = (per(HELD_M), per(HELD_M / node.reach_m.max(1.0)));
                Self { at: State::of(&earlier, node), per: [p, p, p, t, t, t, t] }
            }
            None => {
                let (p, t, h) = (per(POSITION_M), per(TILT_RAD), per(HEADING_RAD));
                Self { at: State::START, per: [p, p, p, t, t, h, per(node.scale_sigma)] }
            }
        }
    }
}

/// Settles the graph. What was settled before is held, unless that leaves neighbours farther apart than they need be by more than a
/// model may move and be taken for unmoved.
pub fn settle(nodes: &[Node], links: &[Link]) -> Settled {
    let free = settle_held(nodes, links, &vec![false; nodes.len()]);
    let mut held: Vec<bool> = nodes.iter().map(|n| n.earlier.is_some()).collect();
    while held.contains(&true) {
        let settled = settle_held(nodes, links, &held);
        let is_strained = |i: &usize| free.holds[*i] && settled.apart_m[*i] > free.apart_m[*i] + STAYS_M;
        let strained: Vec<usize> = (0..links.len()).filter(is_strained).collect();
        if strained.is_empty() {
            return settled;
        }
        // Whoever is strained is let go; then, if that is not enough, whoever holds them.
        let ends: Vec<usize> = strained.iter().flat_map(|i| [links[*i].a, links[*i].b]).collect();
        let let_go = match ends.iter().any(|end| held[*end]) {
            true => ends,
            false => {
                let beside = links.iter().filter(|l| ends.contains(&l.a) || ends.contains(&l.b));
                beside.flat_map(|l| [l.a, l.b]).filter(|i| held[*i]).collect()
            }
        };
        if let_go.is_empty() {
            break;
        }
        let_go.into_iter().for_each(|i| held[i] = false);
    }
    free
}

fn settle_held(nodes: &[Node], links: &[Link], held: &[bool]) -> Settled {
    let is_likely = |l: &Link| l.places.iter().all(|(a, b)| a.distance(*b) <= MOST_APART_M);
    let likely: Vec<usize> = (0..links.len()).filter(|i| is_likely(&links[*i])).collect();
    let used: Vec<Link> = likely.iter().map(|i| links[*i]).collect();
    let priors: Vec<Prior> = nodes.iter().zip(held).map(|(n, h)| Prior::of(n, *h)).collect();
    let mut solver = Solver {
        nodes,
        links: &used,
        states: priors.iter().map(|p| p.at).collect(),
        priors,
        weights: vec![1.0; used.len()],
        levers: vec![[(DVec3::ZERO, DVec3::ZERO); 6]; used.len()],
    };
    solver.step();
    let beyond = |s: &Solver<'_>, i: usize| s.apart2(i) / used[i].limit_m.powi(2);
    let worst = (0..used.len()).map(|i| beyond(&solver, i)).fold(0.0, f64::max);
    let mut width = 2.0 * worst;
    while width > 1.0 {
        for i in 0..used.len() {
            solver.weights[i] = (width / (beyond(&solver, i) + width)).powi(2);
        }
        solver.step();
        width /= SHRINK;
    }
    for _ in 0..LAST_STEPS {
        for i in 0..used.len() {
            solver.weights[i] = (1.0 / (beyond(&solver, i) + 1.0)).powi(2);
        }
        solver.step();
    }
    let (mut holds, mut apart_m) = (vec![false; links.len()], vec![f64::INFINITY; links.len()]);
    for (used, link) in likely.iter().enumerate() {
        holds[*link] = solver.weights[used] >= SET_ASIDE;
        apart_m[*link] = solver.apart2(used).sqrt();
    }
    let corrections = solver.states.iter().zip(nodes).map(|(s, n)| s.similarity(n)).collect();
    Settled { corrections, holds, apart_m }
}

struct Solver<'a> {
    nodes: &'a [Node],
    links: &'a [Link],
    priors: Vec<Prior>,
    states: Vec<State>,
    weights: Vec<f64>,
    /// Per link and place: from both middles, as the states have them.
    levers: Vec<[(DVec3, DVec3); 6]>,
}

impl Solver<'_> {
    /// Mean square distance of a link's places, m².
    fn apart2(&self, link: usize) -> f64 {
        let l = &self.links[link];
        let place = |i: usize, p: DVec3| {
            let (n, s) = (&self.nodes[i], &self.states[i]);
            n.middle + s.shift + s.lever(n, p)
        };
        l.places.iter().map(|(a, b)| place(l.a, *a).distance_squared(place(l.b, *b))).sum::<f64>() / 6.0
    }

    /// What a link's places weigh.
    fn weight(&self, link: usize) -> f64 {
        self.weights[link] / (6.0 * self.links[link].sigma_m.powi(2))
    }

    /// One step of Gauss and Newton.
    fn step(&mut self) {
        for (levers, l) in self.levers.iter_mut().zip(self.links) {
            for (lever, (a, b)) in levers.iter_mut().zip(&l.places) {
                *lever = (self.states[l.a].lever(&self.nodes[l.a], *a), self.states[l.b].lever(&self.nodes[l.b], *b));
            }
        }
        let mut gradient = vec![[0.0; 7]; self.nodes.len()];
        for (i, l) in self.links.iter().enumerate() {
            let w = self.weight(i);
            for (ya, yb) in &self.levers[i] {
                let (a, b) = (l.a, l.b);
                let apart = self.nodes[a].middle + self.states[a].shift + *ya
                    - (self.nodes[b].middle + self.states[b].shift + *yb);
                Self::push(&mut gradient[a], *ya, -w * apart);
                Self::push(&mut gradient[b], *yb, w * apart);
            }
        }
        for (i, g) in gradient.iter_mut().enumerate() {
            let (s, Prior { at, per }) = (&self.states[i], &self.priors[i]);
            let (shift, turned) = (s.shift - at.shift, (s.turn * at.turn.conjugate()).to_scaled_axis());
            let off = [shift.x, shift.y, shift.z, turned.x, turned.y, turned.z, s.log_scale - at.log_scale];
            (0..7).for_each(|k| g[k] -= per[k] * off[k]);
        }
        let steps = self.solve(gradient);
        self.states.iter_mut().zip(&steps).for_each(|(s, by)| s.step(by));
    }

    /// Adds what a pull on a place with this lever does to a node's block.
    fn push(block: &mut Block, lever: DVec3, pull: DVec3) {
        let torque = lever.cross(pull);
        let add = [pull.x, pull.y, pull.z, torque.x, torque.y, torque.z, lever.dot(pull)];
        (0..7).for_each(|k| block[k] += add[k]);
    }

    /// How a place with this lever moves when its node's block does.
    fn moved(block: &Block, lever: DVec3) -> DVec3 {
        DVec3::new(block[0], block[1], block[2])
            + DVec3::new(block[3], block[4], block[5]).cross(lever)
            + block[6] * lever
    }

    /// The matrix of the normal equations times `x`.
    fn times(&self, x: &[Block], into: &mut [Block]) {
        for (i, block) in into.iter_mut().enumerate() {
            *block = std::array::from_fn(|k| self.priors[i].per[k] * x[i][k]);
        }
        for (i, l) in self.links.iter().enumerate() {
            let w = self.weight(i);
            for (ya, yb) in &self.levers[i] {
                let u = w * (Self::moved(&x[l.a], *ya) - Self::moved(&x[l.b], *yb));
                Self::push(&mut into[l.a], *ya, u);
                Self::push(&mut into[l.b], *yb, -u);
            }
        }
    }

    /// Factors of the blocks on the diagonal.
    fn blocks(&self) -> Vec<[Block; 7]> {
        let diagonal = |prior: &Prior| -> [Block; 7] {
            std::array::from_fn(|r| std::array::from_fn(|c| if r == c { prior.per[r] } else { 0.0 }))
        };
        let mut blocks: Vec<[Block; 7]> = self.priors.iter().map(diagonal).collect();
        for (i, l) in self.links.iter().enumerate() {
            let w = self.weight(i);
            for (ya, yb) in &self.levers[i] {
                for (node, lever) in [(l.a, *ya), (l.b, *yb)] {
                    for column in 0..7 {
                        let unit: Block = std::array::from_fn(|k| f64::from(u8::from(k == column)));
                        let mut pulled = [0.0; 7];
                        Self::push(&mut pulled, lever, w * Self::moved(&unit, lever));
                        (0..7).for_each(|row| blocks[node][row][column] += pulled[row]);
                    }
                }
            }
        }
        blocks.into_iter().map(cholesky).collect()
    }

    /// Solves the normal equations by conjugate gradients.
    fn solve(&self, gradient: Vec<Block>) -> Vec<Block> {
        let factors = self.blocks();
        let dot = |a: &[Block], b: &[Block]| a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| a * b).sum();
        let conditioned =
            |r: &[Block]| -> Vec<Block> { r.iter().zip(&factors).map(|(r, f)| substitute(f, r)).collect() };
        let mut x = vec![[0.0; 7]; gradient.len()];
        let mut r = gradient;
        let mut z = conditioned(&r);
        let mut p = z.clone();
        let mut rz: f64 = dot(&r, &z);
        let enough = rz * TOLERANCE * TOLERANCE;
        let mut ap = x.clone();
        for _ in 0..MOST_ROUNDS {
            if rz <= enough || rz <= f64::MIN_POSITIVE {
                break;
            }
            self.times(&p, &mut ap);
            let pap: f64 = dot(&p, &ap);
            let alpha = rz / pap;
            for (i, block) in x.iter_mut().enumerate() {
                (0..7).for_each(|k| block[k] += alpha * p[i][k]);
                (0..7).for_each(|k| r[i][k] -= alpha * ap[i][k]);
            }
            z = conditioned(&r);
            let next: f64 = dot(&r, &z);
            let beta = next / rz;
            rz = next;
            p.iter_mut().zip(&z).for_each(|(p, z)| (0..7).for_each(|k| p[k] = z[k] + beta * p[k]));
        }
        x
    }
}

/// The lower factor of a symmetric positive definite block (the priors make it so).
fn cholesky(mut m: [Block; 7]) -> [Block; 7] {
    for j in 0..7 {
        let below: f64 = (0..j).map(|k| m[j][k] * m[j][k]).sum();
        m[j][j] = (m[j][j] - below).max(f64::MIN_POSITIVE).sqrt();
        for i in j + 1..7 {
            let below: f64 = (0..j).map(|k| m[i][k] * m[j][k]).sum();
            m[i][j] = (m[i][j] - below) / m[j][j];
        }
    }
    m
}

fn substitute(factor: &[Block; 7], b: &Block) -> Block {
    let mut x = *b;
    for i in 0..7 {
        let below: f64 = (0..i).map(|k| factor[i][k] * x[k]).sum();
        x[i] = (x[i] - below) / factor[i][i];
    }
    for i in (0..7).rev() {
        let above: f64 = (i + 1..7).map(|k| factor[k][i] * x[k]).sum();
        x[i] = (x[i] - above) / factor[i][i];
    }
    x
}

#[cfg(test)]
mod tests;
