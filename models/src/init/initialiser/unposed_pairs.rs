//! The order of work where the network is told no poses: every pair once, then all of them aligned.

use std::time::Instant;

use crate::camera::View;
use crate::init::InitError;
use crate::init::pairs::{SkippedPairs, partners};
use crate::init::unposed::{Heads, align_frames, appearance, keep_better};

use super::{Initialiser, Pairs, middle};

impl Initialiser {
    /// All pairs through an unposed network, then the global alignment.
    pub(super) fn align_pairs(&mut self, views: &[View]) -> Result<(), InitError> {
        let mut pairs: Vec<[usize; 2]> = Vec::new();
        for i in 0..views.len() {
            let Some(range) = self.known_range(i) else {
                return Err(InitError::NoRange { points: self.range.len() });
            };
            self.report.searched(range);
            let good = partners((i, &views[i]), views, middle(range), &self.settings, &mut SkippedPairs::default());
            pairs.extend(good.into_iter().map(|(j, _)| [i.min(j), i.max(j)]));
        }
        pairs.sort_unstable();
        pairs.dedup();
        let Pairs::Unposed(network) = &mut self.pairs else { return Ok(()) };
        let mut edges = Vec::with_capacity(pairs.len());
        let mut heads: Vec<Option<Heads>> = vec![None; views.len()];
        for (e, pair) in pairs.into_iter().enumerate() {
            let started = Instant::now();
            let (edge, [first, second]) = network.run(&self.frames, pair, self.settings.stride as usize, e)?;
            keep_better(&mut heads[pair[0]], first);
            keep_better(&mut heads[pair[1]], second);
            edges.push(edge);
            self.report.runs += 1;
            self.report.times.run_ms += started.elapsed().as_secs_f64() * 1e3;
        }
        let residual = network.pair().sh_residual;
        let started = Instant::now();
        let alignment = align_frames(&mut self.frames, &edges, &self.settings)?;
        self.report.alignment.edges = edges.len();
        self.report.alignment.edges_without_scale = alignment.sigma.iter().filter(|s| s.is_none()).count();
        self.report.alignment.components = crate::align::graph::components(views.len(), &edges).1;
        self.report.alignment.align_steps = alignment.steps;
        self.report.alignment.align_residual_m = alignment.mean_residual;
        self.appearance.clear();
        for (frame, heads) in self.frames.iter().zip(&heads) {
            let made = frame.depth()?.zip(heads.as_ref()).and_then(|(grid, heads)| {
                let first = &views[edges[heads.edge].first];
                appearance(heads, (&frame.view, &grid), first, &alignment, &self.settings, residual)
            });
            self.appearance.push(made);
        }
        self.report.times.align_ms += started.elapsed().as_secs_f64() * 1e3;
        Ok(())
    }
}
