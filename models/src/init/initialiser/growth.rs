//! In flight: what has come since the last build goes into Gaussians of its own ground, at a cost that depends on how much pictures
//! overlap, never on how many there are.

use std::collections::HashSet;
use std::time::Instant;

use super::{Initialiser, Pairs, middle};
use crate::camera::{DepthPrior, Pinhole, View};
use crate::init::InitError;
use crate::init::lighting::gain_of;
use crate::init::report::{Growth, Initialisation};
use crate::light::Light;

/// Squares that the width of a picture is divided into when ground is counted.
const ACROSS: f64 = 24.0;

impl Initialiser {
    /// Whether what comes can be added to what there is: an unposed network aligns all pairs anew.
    pub fn grows(&self) -> bool {
        matches!(self.pairs, Pairs::Posed(_))
    }

    /// Compares the light of all pictures anew; `None` where it is even.
    ///
    /// # Errors
    /// The frames' file fails.
    pub fn survey_light(&mut self) -> Result<Option<&Light>, InitError> {
        if self.settings.light {
            self.light = self.measure_light()?;
        }
        Ok(self.light.as_ref())
    }

    /// Pictures that came since the last build or growth, and those beside them whose depths are better made anew, into as many
    /// Gaussians as `gaussians` says of so many square metres of ground. `prior` takes D_est of these pictures. `None` when none of
    /// them has a depth yet.
    ///
    /// # Errors
    /// The network or the frames' file fails.
    pub fn grow(
        &mut self,
        gaussians: &dyn Fn(f64) -> usize,
        prior: &mut dyn FnMut(&str, DepthPrior),
    ) -> Result<Option<(Initialisation, Growth)>, InitError> {
        let started = Instant::now();
        let (from, until) = (self.fused, self.frames.len());
        self.ranges.truncate(from);
        for i in self.ranges.len()..until {
            let range = self.settings.depth_m.or_else(|| self.range.of(&self.frames[i].view));
            self.ranges.push(range);
        }
        self.fused = until;
        let new: Vec<usize> = (from..until).filter(|i| self.known_range(*i).is_some()).collect();
        let mut beside: Vec<usize> = new.iter().flat_map(|i| self.witnesses(*i)).filter(|i| *i < from).collect();
        beside.sort_unstable();
        beside.dedup();
        let stale = beside.iter().copied().filter(|i| self.is_stale(*i) && self.known_range(*i).is_some());
        let mut changed: Vec<usize> = stale.chain(new).collect();
        changed.sort_unstable();
        self.make_depths(&changed)?;
        self.report.times.depth_ms += started.elapsed().as_secs_f64() * 1e3;
        changed.retain(|i| self.frames[*i].has_depth());
        if changed.is_empty() {
            return Ok(None);
        }
        self.light_of_new(from)?;
        let growth = Growth { depths: changed.len(), compared: beside.len(), ground_m2: self.ground_of(&changed) };
        let made = self.assemble(&changed, gaussians(growth.ground_m2).max(1), prior)?;
        Ok(Some((made, growth)))
    }

    /// Where light is uneven, what new pictures are in, by those that show the same ground and whose light is known.
    fn light_of_new(&mut self, from: usize) -> Result<(), InitError> {
        for i in from..self.frames.len() {
            let Some(light) = &self.light else { return Ok(()) };
            let known: Vec<usize> =
                self.witnesses(i).into_iter().filter(|j| light.gains.contains_key(&self.frames[*j].name)).collect();
            let gain = gain_of(&self.frames, i, &known, light, self.settings.depth_tolerance)?;
            if let (Some(gain), Some(light)) = (gain, &mut self.light) {
                light.gains.insert(self.frames[i].name.clone(), gain);
            }
        }
        Ok(())
    }

    /// Ground that all pictures show, m².
    pub fn ground_m2(&self) -> f64 {
        self.ground_of(&(0..self.frames.len()).collect::<Vec<_>>())
    }

    /// Ground that pictures show, m², each place counted once.
    fn ground_of(&self, pictures: &[usize]) -> f64 {
        let Some([width, _]) = pictures.first().and_then(|i| self.footprint_m(*i)) else { return 0.0 };
        let side = width / ACROSS;
        let mut seen: HashSet<[i64; 2]> = HashSet::new();
        for &i in pictures {
            let (view, Some(depth)) = (self.frames[i].view, self.typical_depth(i)) else { continue };
            let (camera, k) = (Pinhole::from(&view), view.intrinsics);
            // Twice as close as the squares, so that none between is missed.
            let steps = (2.0 * ACROSS) as u32;
            for (x, y) in (0..steps).flat_map(|y| (0..steps).map(move |x| (x, y))) {
                let at = |v: u32, side: u32| (f64::from(v) + 0.5) as f32 / steps as f32 * side as f32;
                let place = camera.unproject([at(x, k.width), at(y, k.height)], depth) / side;
                seen.insert([place.x.floor() as i64, place.y.floor() as i64]);
            }
        }
        seen.len() as f64 * side * side
    }

    /// Width and height of the ground that picture `i` shows, metres, at its typical depth.
    pub fn footprint_m(&self, i: usize) -> Option<[f64; 2]> {
        let View { intrinsics: k, .. } = self.frames.get(i)?.view;
        let depth = self.known_range(i).map(middle)?;
        Some([depth * f64::from(k.width) / f64::from(k.fx), depth * f64::from(k.height) / f64::from(k.fy)])
    }
}
