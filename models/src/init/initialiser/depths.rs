//! Which depths are to be made, and making them.

use super::{Initialiser, Pairs, STALE_PX, middle};
use crate::camera::View;
use crate::init::InitError;
use crate::init::depth_frame::shift;
use crate::init::pairs::{Relation, relate};
use crate::init::posed::Request;

impl Initialiser {
    pub(super) fn is_stale(&self, i: usize) -> bool {
        let frame = &self.frames[i];
        let (Some(as_view), Some(depth)) = (&frame.made_as, self.typical_depth(i)) else { return true };
        let moved = frame
            .made_with
            .iter()
            .any(|(s, old)| shift(&frame.view, &self.frames[*s].view, as_view, old, depth as f32) > STALE_PX);
        let quality = |list: &mut dyn Iterator<Item = View>| -> f64 {
            list.map(|v| match relate(&frame.view, &v, depth, &self.settings) {
                Relation::Good(score) => score,
                Relation::Bad(_) => 0.0,
            })
            .sum()
        };
        let now = quality(&mut frame.made_with.iter().map(|(s, _)| self.frames[*s].view));
        let best: f64 = self.sources_of(i, depth).iter().map(|s| s.1).sum();
        moved || best > 1.5 * now
    }

    /// Makes the depths of the given pictures, several at once.
    pub(super) fn make_depths(&mut self, wanted: &[usize]) -> Result<(), InitError> {
        let mut chosen = Vec::with_capacity(wanted.len());
        for &i in wanted {
            let Some(range) = self.known_range(i) else {
                return Err(InitError::NoRange { points: self.range.len() });
            };
            chosen.push((i, range, self.sources_of(i, middle(range))));
        }
        let Pairs::Posed(network) = &mut self.pairs else { return Ok(()) };
        let frames = &self.frames;
        let requests: Vec<Request<'_>> = chosen
            .iter()
            .filter(|(_, _, sources)| !sources.is_empty())
            .map(|(i, range, sources)| Request {
                reference: &frames[*i],
                sources: sources.iter().map(|s| &frames[s.0]).collect(),
                range: *range,
            })
            .collect();
        let mut made = network.run_all(&requests, self.settings.stride as usize)?.into_iter();
        self.report.times.open_ms = network.opening_ms();
        for (i, range, sources) in chosen {
            let made_with = sources.iter().map(|s| (s.0, self.frames[s.0].view)).collect();
            let made = if sources.is_empty() { None } else { made.next() };
            if let Some(made) = &made {
                self.report.non_finite_depths += made.non_finite;
                self.report.runs += 1;
                self.report.times.run_ms += made.run_ms;
                self.report.searched(range);
            }
            let frame = &mut self.frames[i];
            frame.set_depth(made.map(|m| m.grid))?;
            frame.made_with = made_with;
            frame.made_as = Some(frame.view);
        }
        Ok(())
    }
}
