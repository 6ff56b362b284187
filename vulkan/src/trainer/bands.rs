//! Bands: consecutive tiles whose instances fit the plan. One band is the rule; several give the same bits.

use super::{TrainError, Trainer};
use crate::commands::{Push, Recording};
use crate::kernels::Kernel;
use crate::stages::Stage;
use config::plan::LOOP_LANES;

/// Where the sorting lanes leave their cursors in `status` (`shaders/walk.glsl`).
const WALK_CURSORS: usize = 1024;
/// Rounds of counting and emitting to begin with; more are taken, and kept, when a frame needs them.
pub(crate) const WALK_ROUNDS: u32 = 2;

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

impl Trainer {
    /// Depth sort, colours, instances per tile; everything up to where the number of instances is needed.
    pub(super) fn record_counting(&self, recording: &Recording<'_>) {
        recording.run(Kernel::Project, self.gaussians, Push::default());
        let blocks = self.plan.sort_lanes as usize;
        for pass in 0..4 {
            let push = Push { pass, ..Push::default() };
            let (count, scatter) = if pass % 2 == 0 {
                (Kernel::SortCount, Kernel::SortScatter)
            } else {
                (Kernel::SortCountOther, Kernel::SortScatterBack)
            };
            recording.run(count, blocks, push);
            recording.run(Kernel::SortScan, 256, push);
            recording.run(scatter, blocks, push);
        }
        recording.run(Kernel::Shade, LOOP_LANES as usize, Push::default());
        self.record_tiles(recording);
    }

    /// Instances per tile and their prefix sums.
    pub(super) fn record_tiles(&self, recording: &Recording<'_>) {
        let tiles = self.frame.tiles();
        let all = Push { first: 0, last: tiles, ..Push::default() };
        let bytes = 4 * u64::from(tiles) * u64::from(self.plan.sort_lanes);
        recording.clear(&self.arena, self.arena.section("tiles"), bytes, Stage::Count);
        recording.run_rounds(Kernel::Count, self.plan.sort_lanes as usize, all, self.walk_rounds);
        recording.run(Kernel::TilePrefix, tiles as usize, all);
        recording.run(Kernel::TileScan, 256, all);
    }

    /// Instance lists of a band. The only band of a frame was counted already.
    pub(super) fn record_emit(&self, recording: &Recording<'_>, band: Band, single: bool) {
        let push = Push { first: band.first, last: band.last, mode: 1, pass: 0 };
        if !single {
            recording.run_rounds(Kernel::Count, self.plan.sort_lanes as usize, push, self.walk_rounds);
        }
        recording.run_rounds(Kernel::Emit, self.plan.sort_lanes as usize, push, self.walk_rounds);
    }

    pub(super) fn record_blend(&self, recording: &Recording<'_>, band: Band) {
        let push = Push { first: band.first, last: band.last, ..Push::default() };
        recording.run(Kernel::Rasterise, (band.last - band.first) as usize, push);
    }

    /// Reads the counts and cuts the tiles into bands. Counting is done again with twice the rounds for as long as some
    /// lane did not reach the end of its share.
    pub(super) fn cut_bands(&mut self) -> Result<Counted, TrainError> {
        while !self.walk_is_complete() {
            self.walk_rounds = self.walk_rounds.saturating_mul(2);
            let recording = self.take_recording()?;
            self.record_tiles(&recording);
            recording.submit()?;
        }
        let tiles = self.frame.tiles();
        let status = self.arena.slice::<u32>(self.arena.section("status"));
        let (visible, total) = (status[0] as usize, status[1]);
        self.bands.clear();
        if total as usize <= self.plan.instances && total != u32::MAX {
            self.bands.push(Band { first: 0, last: tiles });
            return Ok(Counted { visible, instances: total.into() });
        }
        let starts = self.arena.slice::<u32>(self.arena.section("tile_starts"));
        let (mut first, mut held, mut instances) = (0u32, 0usize, 0u64);
        for t in 0..tiles {
            // Starts wrap at 2^32; a single tile's count does not.
            let count = starts[t as usize + 1].wrapping_sub(starts[t as usize]) as usize;
            instances += count as u64;
            if held + count > self.plan.instances && t > first {
                self.bands.push(Band { first, last: t });
                (first, held) = (t, 0);
            }
            held += count;
        }
        self.bands.push(Band { first, last: tiles });
        Ok(Counted { visible, instances })
    }

    fn walk_is_complete(&self) -> bool {
        let status = self.arena.slice::<u32>(self.arena.section("status"));
        (0..self.plan.sort_lanes as usize).all(|lane| status[WALK_CURSORS + 4 * lane + 3] == 1)
    }
}
