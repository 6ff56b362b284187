//! Bands: consecutive tiles whose instances fit the plan. One band is the rule; several give the same bits.

use super::Device;
use crate::error::TrainError;
use crate::gpu::GpuError;

/// Rounds of counting and emitting to begin with; more are taken, and kept, when a frame needs them.
pub(crate) const WALK_ROUNDS: u32 = 2;

/// What counting leaves for the host.
pub(super) const COUNTS: [&str; 2] = ["status", "tile_starts"];

/// Tiles [first, last).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Band {
    pub first: u32,
    pub last: u32,
}

/// What the counting submission found.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Counted {
    pub visible: usize,
    pub instances: u64,
}

impl Device {
    /// Reads the counts and cuts the tiles into bands. Counting is done again with twice the rounds for as long as some
    /// lane did not reach the end of its share.
    ///
    /// # Errors
    /// [`GpuError::ComputesNothing`] when twice the rounds take no lane any further.
    pub(super) fn cut_bands(&mut self) -> Result<Counted, TrainError> {
        let mut reached = None;
        while !self.walk_is_complete() {
            let walked = self.walked();
            if reached == Some(walked) {
                return Err(GpuError::ComputesNothing.into());
            }
            reached = Some(walked);
            self.walk_rounds = self.walk_rounds.saturating_mul(2);
            let recording = self.begin()?;
            self.record_tiles(&recording);
            recording.submit_and_read(&COUNTS)?;
        }
        let (visible, total) = (self.status().visible as usize, self.status().instances);
        let starts = self.arena.slice::<u32>(self.arena.section("tile_starts"));
        let starts = &starts[..=self.frame.tiles() as usize];
        Ok(Counted { visible, instances: cut(starts, total, self.plan.instances, &mut self.bands) })
    }

    /// How far all lanes together have come: grows with every round, because each goes on for at least a row of tiles.
    fn walked(&self) -> u64 {
        let (gaussians, instances) = (self.status().cursors.iter().map(|c| c.gaussian), self.status().lane_instances);
        gaussians.chain(instances).map(u64::from).sum()
    }

    fn walk_is_complete(&self) -> bool {
        self.status().lane_counted[..self.plan.lanes.sort as usize].iter().all(|counted| *counted == 1)
    }
}

/// Consecutive tiles with at most `capacity` instances each (or one tile alone), and how many instances there are in all.
/// `starts`: the first instance of every tile, and the end, modulo 2^32; `total`: their number, 2^32 - 1 when it is more.
fn cut(starts: &[u32], total: u32, capacity: usize, bands: &mut Vec<Band>) -> u64 {
    let tiles = starts.len() as u32 - 1;
    bands.clear();
    if total as usize <= capacity && total != u32::MAX {
        bands.push(Band { first: 0, last: tiles });
        return total.into();
    }
    let (mut first, mut held, mut instances) = (0u32, 0usize, 0u64);
    for (t, ends) in (0u32..).zip(starts.windows(2)) {
        // A single tile's count does not wrap: there are fewer Gaussians than 2^32.
        let count = ends[1].wrapping_sub(ends[0]) as usize;
        instances += count as u64;
        if held + count > capacity && t > first {
            bands.push(Band { first, last: t });
            (first, held) = (t, 0);
        }
        held += count;
    }
    bands.push(Band { first, last: tiles });
    instances
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Fixture;
    use crate::gpu::{Forced, Gpu};
    use crate::synthetic::{cloud, photo, plain, posed, view};
    use crate::trainer::Trainer;
    use config::plan::{Plan, PlanRequest};

    #[test]
    fn a_device_whose_kernels_have_no_effect_is_named_instead_of_counted_on_for_ever() {
        let Ok(gpu) = Gpu::open(None) else { return needs::missing(needs::Need::Vulkan, "no Vulkan device") };
        let gpu = gpu.forced(Forced { computes_nothing: true, ..Forced::default() });
        let v = view(32, 24);
        let request = PlanRequest { width: 32, height: 24, views: 1, sh_degree: 0, ..Default::default() };
        let plan = Plan::with_capacities(&request, 256, 4096);
        let mut trainer =
            Trainer::with_kernels(&gpu, &plan, &plain(), crate::kernel_config::KernelConfig::standard(gpu.info()), &[])
                .map(Fixture::from)
                .unwrap();
        trainer.load(&cloud(1, 64, 0)).unwrap();
        trainer.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
        assert_eq!(trainer.step().err(), Some(TrainError::Gpu(GpuError::ComputesNothing)));
        assert_eq!(trainer.device.walk_rounds, 2 * WALK_ROUNDS, "one more try");
    }

    /// Starts modulo 2^32 and the saturated total, as `tile_scan` leaves them.
    fn scanned(counts: &[u32]) -> (Vec<u32>, u32) {
        let mut starts = vec![0u32];
        counts.iter().for_each(|c| starts.push(starts[starts.len() - 1].wrapping_add(*c)));
        (starts, counts.iter().fold(0, |sum: u32, c| sum.saturating_add(*c)))
    }

    #[test]
    fn every_tile_is_in_one_band_and_no_band_holds_more_than_the_plan() {
        for (counts, capacity, expected) in [
            (vec![3, 0, 4, 5], 100, vec![(0, 4)]),
            (vec![3, 0, 4, 5], 12, vec![(0, 4)]),
            (vec![3, 0, 4, 5], 7, vec![(0, 3), (3, 4)]),
            (vec![3, 0, 4, 5], 5, vec![(0, 2), (2, 3), (3, 4)]),
            (vec![0; 3], 5, vec![(0, 3)]),
        ] {
            let (starts, total) = scanned(&counts);
            let mut bands = Vec::new();
            assert_eq!(cut(&starts, total, capacity, &mut bands), u64::from(counts.iter().sum::<u32>()));
            assert_eq!(bands, expected.into_iter().map(|(first, last)| Band { first, last }).collect::<Vec<_>>());
        }
    }

    #[test]
    fn more_than_two_to_the_thirty_second_instances_are_counted_and_cut_without_wrapping() {
        // 2^31 + 1, then 2^32 and a bit more than that, which modulo 2^32 looks like little.
        for (tiles, of_each) in [(2049, 1 << 20), (4096, 1 << 20), (4097, 1 << 20), (3, u32::MAX / 2 + 1)] {
            let (starts, total) = scanned(&vec![of_each; tiles]);
            let mut bands = Vec::new();
            let counted = cut(&starts, total, of_each as usize, &mut bands);
            assert_eq!(counted, tiles as u64 * u64::from(of_each));
            assert!(bands.len() == tiles && bands.iter().all(|b| b.last == b.first + 1));
        }
    }
}
