//! Models of different aircraft lie decimetres to metres apart, because each holds to its own GPS. Where two of them show
//! the same ground they can be brought together before they are cut and merged.
//!
//! Pairs whose ground overlaps are fitted onto each other, each pair once ([`fit`], [`edge`]), and one robust graph over all models
//! then says where each one lies (`graph`). An aircraft that joins costs the fits to its neighbours; the graph over all of
//! them costs less than one fit.

use std::collections::HashSet;

use super::frame::Motion;
use super::hold::Held;
use super::member::Member;
use edge::{Edges, Fitted, Key};
use graph::{Link, Node};

pub mod edge;
pub mod fit;
mod graph;
mod neighbours;

/// Least that an edge's common place is known to, metres: models are bent by more than their points' noise.
const LEAST_SIGMA_M: f64 = 0.05;
/// Of so many points that agree one counts: neighbouring features err alike.
const POINTS_ALIKE: f64 = 10.0;
/// What the size of a model is known to, one standard deviation, as a share: one whose origin is known has it from its cameras' GPS,
/// decimetres over some fifty metres of flight (`dgtr demo`: 0.07 % and 0.10 % off, in opposite directions); another one from nothing.
const SCALE_BY_GPS: f64 = 0.005;
const SCALE_BY_NOTHING: f64 = 0.05;
/// An edge holds while its places are no farther apart than this many times what its own points are, and this much more.
const LIMIT_RMS: f64 = 3.0;
const LIMIT_M: f64 = 0.3;

/// Whoever can fit one model onto another.
pub trait Fitter {
    /// The motion that brings `second` onto `first`, when they have enough in common.
    ///
    /// # Errors
    /// What is needed for it cannot be used: the device, the network, a file.
    fn fit(&mut self, first: &Member, second: &Member) -> Result<Option<Fitted>, String>;
}

/// What became of one model.
#[derive(Clone, Debug, PartialEq)]
pub struct Registration {
    /// The model.
    pub name: String,
    /// Those it was fitted onto.
    pub neighbours: Vec<String>,
    /// By how far its middle moved, metres.
    pub moved_m: f64,
    /// By how much it turned, degrees.
    pub turned_deg: f64,
    /// By what factor its size changed.
    pub scale: f64,
    /// Root mean square distance of its points from its neighbours', metres, as their fits left them.
    pub rms_m: f64,
}

/// What became of all.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Registered {
    /// Models that have neighbours, in the order given.
    pub models: Vec<Registration>,
    /// Pairs whose ground overlaps.
    pub pairs: usize,
    /// Pairs fitted now; the others were known.
    pub fitted: usize,
    /// Pairs whose fit contradicts the others', and what was known of a pair and could not be used.
    pub warnings: Vec<String>,
}

/// One pair of a round.
struct Pair {
    /// The two, by index; the first is the one whose content comes first, whatever order they are given in.
    first: usize,
    second: usize,
    found: Option<Fitted>,
}

/// Fits what is not known, and says what of it holds.
pub struct Registrar<F> {
    edges: Edges,
    fitter: F,
}

impl<F: Fitter> Registrar<F> {
    /// With what is known already.
    pub fn new(edges: Edges, fitter: F) -> Self {
        Self { edges, fitter }
    }

    /// Fits the pairs that are not known yet and keeps them; returns how many there were. `cancelled` is asked before each.
    ///
    /// # Errors
    /// The fitter's, or the folder of what is known cannot be written to; what was fitted by then is kept.
    pub fn fit(&mut self, members: &[Member], cancelled: &dyn Fn() -> bool) -> Result<usize, String> {
        self.pairs(members, cancelled).map(|(_, _, fitted)| fitted)
    }

    fn pairs(
        &mut self,
        members: &[Member],
        cancelled: &dyn Fn() -> bool,
    ) -> Result<(Vec<Pair>, HashSet<Key>, usize), String> {
        let grounds: Vec<_> = members.iter().map(Member::bounds).collect();
        let ordered = |(a, b): (usize, usize)| match members[a].content() <= members[b].content() {
            true => (a, b),
            false => (b, a),
        };
        let mut wanted: Vec<(usize, usize)> = neighbours::neighbours(&grounds).into_iter().map(ordered).collect();
        // The first of a pair stays on its renderer while all of its pairs are fitted.
        wanted.sort_unstable();
        let (mut pairs, mut used, mut fitted) = (Vec::with_capacity(wanted.len()), HashSet::new(), 0);
        for (first, second) in wanted {
            let key = edge::key(&members[first], &members[second]);
            used.insert(key);
            let found = match self.edges.get(&key) {
                Some(known) => known,
                None if cancelled() => None,
                None => {
                    let found = self.fitter.fit(&members[first], &members[second])?;
                    if let Some(Fitted { points: [agree, all], rms_m: [before, after], .. }) = &found {
                        let (a, b) = (members[first].name(), members[second].name());
                        tracing::debug!(
                            "{b} onto {a}: {agree} of {all} points, {before:.3} m apart before, {after:.3} m after"
                        );
                    }
                    self.edges.put(&key, found)?;
                    fitted += 1;
                    found
                }
            };
            pairs.push(Pair { first, second, found });
        }
        Ok((pairs, used, fitted))
    }

    /// Brings all models together: each moves as its neighbours and its telemetry agree on, or stays where `held` has it while that is
    /// near enough. Models that overlap no other stay where their GPS put them. Pairs that are in use no more are forgotten.
    ///
    /// # Errors
    /// Errors of [`Registrar::fit`]; the models are then as they were.
    pub fn register(
        &mut self,
        members: &mut [Member],
        held: &Held<'_>,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<Registered, String> {
        let (pairs, used, fitted) = self.pairs(members, cancelled)?;
        let mut report = Registered { pairs: pairs.len(), fitted, ..Default::default() };
        let node = |m: &Member| Node {
            middle: m.middle(),
            scale_sigma: if m.is_georeferenced() { SCALE_BY_GPS } else { SCALE_BY_NOTHING },
            reach_m: m.corners().into_iter().map(|c| c.distance(m.middle())).fold(0.0, f64::max),
            earlier: held.earlier(m).map(|motion| *motion.similarity()),
        };
        let nodes: Vec<Node> = members.iter().map(node).collect();
        let found: Vec<(&Pair, Fitted)> = pairs.iter().filter_map(|p| Some((p, p.found?))).collect();
        let links: Vec<Link> = found.iter().map(|(p, fit)| link(members, p, fit)).collect();
        let settled = graph::settle(&nodes, &links);
        let name = |i: usize| members[i].name().to_owned();
        let mut of_model: Vec<Vec<(usize, f64)>> = vec![Vec::new(); members.len()];
        for ((p, fit), holds) in found.iter().zip(&settled.holds) {
            if *holds {
                of_model[p.first].push((p.second, fit.rms_m[1]));
                of_model[p.second].push((p.first, fit.rms_m[1]));
            } else {
                report.warnings.push(format!(
                    "How {} fits onto {} contradicts how the others fit; it was set aside.",
                    name(p.second),
                    name(p.first)
                ));
            }
        }
        let mut corrections = Vec::new();
        for (i, neighbours) in of_model.iter().enumerate().filter(|(_, n)| !n.is_empty()) {
            let motion = held.motion(&members[i], Motion::of(settled.corrections[i]));
            report.models.push(Registration {
                name: name(i),
                neighbours: neighbours.iter().map(|n| name(n.0)).collect(),
                moved_m: motion.point(nodes[i].middle).distance(nodes[i].middle),
                turned_deg: motion.angle().to_degrees(),
                scale: motion.similarity().scale,
                rms_m: (neighbours.iter().map(|n| n.1 * n.1).sum::<f64>() / neighbours.len() as f64).sqrt(),
            });
            corrections.push((i, motion));
        }
        for (i, motion) in corrections {
            members[i].corrected(&motion);
        }
        self.edges.keep_only(&used);
        report.warnings.append(&mut self.edges.damaged);
        Ok(report)
    }
}

/// A fit in the common frame.
fn link(members: &[Member], pair: &Pair, fit: &Fitted) -> Link {
    let (frame, onto) = (members[pair.first].motion(), fit.motion());
    let [_, rms_m] = fit.rms_m;
    let noise2 = rms_m * rms_m * POINTS_ALIKE / f64::from(fit.points[0].max(1));
    Link {
        a: pair.first,
        b: pair.second,
        places: fit.places.map(|p| (frame.point(onto.point(p.into())), frame.point(p.into()))),
        sigma_m: (LEAST_SIGMA_M * LEAST_SIGMA_M + noise2).sqrt(),
        limit_m: LIMIT_M + LIMIT_RMS * rms_m,
    }
}

#[cfg(test)]
mod tests;
