//! The kernel configuration: what is chosen per device. Every kernel works with any of the configurations here and leaves
//! the same bits with each (`tests/kernel_configs.rs`); only the time differs, and `tuning::autotune` measures
//! which is the fastest.

use crate::constants::{RUNS, SHORT_PART, STRIP};
use crate::gpu::GpuInfo;
use std::fmt;

/// Sizes of workgroups, by kind of kernel, and who blends a tile. No kernel knows two of the kinds, so that each is chosen
/// by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KernelConfig {
    /// Lanes of a workgroup: plain loops over Gaussians or pixels.
    pub wide: u32,
    /// Lanes of a workgroup: the kernels that sort, count and emit, each lane or workgroup its share of the Gaussians.
    pub narrow: u32,
    /// Lanes that work on a share: 1, without a barrier, or all of a workgroup (sorting kernels then take 256).
    pub share_lanes: u32,
    /// Tiles of a workgroup: the blend and its gradient.
    pub tiles: u32,
    /// Lanes that share a tile: 1, with all its pixels in registers, or one per run of it. Those read each other's registers, or meet in
    /// shared memory: where they cannot read them, and with two tiles.
    pub tile_lanes: u32,
    /// Gaussians that the lanes of a tile fetch at once: 1, or as many as there are lanes, each for all.
    pub fetched: u32,
    /// Lanes of a tile whose sums are added at once: 1, where registers are few (one after the other in a loop, and the gradients of a
    /// tile's pixels are fetched again for each Gaussian), or all of them.
    pub summed: u32,
    /// Pixels of a strip whose SSIM sums a lane holds at once: all of it, or [`SHORT_PART`].
    pub part: u32,
}

/// Sizes worth trying. All divide the lanes that the looping kernels are written for ([`config::plan::Lanes`]), so that no lane runs beyond them.
const WIDE: [u32; 4] = [32, 64, 128, 256];
const NARROW: [u32; 3] = [8, 16, 32];
const TILES: [u32; 3] = [8, 16, 32];
/// Tiles worth trying where their lanes meet in shared memory and all of a workgroup wait for each other. So few as the first are never
/// blended otherwise: where lanes can read each other, it says that they meet nevertheless.
const MEETING_TILES: [u32; 2] = [2, 8];

/// PCI vendor of VideoCore GPUs (a Raspberry Pi's).
const BROADCOM: u32 = 0x14e4;

impl KernelConfig {
    /// What is used where nothing was measured.
    pub fn standard(info: &GpuInfo) -> Self {
        // Software renderers run a workgroup on one core: small groups of tiles balance better there.
        let few = if info.is_cpu { 8 } else { 32 };
        // A whole tile is more than a GPU's lane has registers for: V3D spills 308/588 then, with a lane per run 4/4, Adreno
        // 49/49 and nothing (tests/data/boards.md).
        let (tiles, tile_lanes) = match (info.is_cpu, info.shuffles) {
            (true, _) => (few, 1),
            (false, true) if 8 * RUNS <= info.limits.workgroup_lanes => (8, RUNS),
            (false, false) if MEETING_TILES[0] * RUNS >= info.subgroup_size => (MEETING_TILES[0], RUNS),
            (false, false) => (MEETING_TILES[1], RUNS),
            (false, true) => (few, 1),
        };
        // Of the blend's gradient a Mali-G610's compiler spills 292/383 where all are added at once, 4/4 where in a loop, and an Adreno
        // loses two thirds of its waves; V3D 7's 4/4 and 23/25 (tests/data/boards.md). Where lanes meet in shared memory each adds up
        // what another one does not, and none of them spills more at once. Cards have registers for it.
        let in_a_loop = info.is_integrated && info.shuffles && info.ids.0 != BROADCOM;
        let summed = if in_a_loop { 1 } else { tile_lanes };
        // A card has lanes enough for every share's histogram (an H100: sorting, counting and emitting 0.3 ms instead of 1.4).
        let card = !info.is_cpu && !info.is_integrated && few >= info.subgroup_size;
        // The sums of a whole strip are more than a small GPU's lane has registers for, too.
        let part = if info.is_cpu || !info.is_integrated { STRIP } else { SHORT_PART };
        Self {
            wide: 64,
            narrow: few,
            share_lanes: if card { few } else { 1 },
            tiles,
            tile_lanes,
            fetched: 1,
            summed,
            part,
        }
    }

    /// Sizes of wide workgroups that this device can run and that fill its subgroups, the standard one among them.
    pub fn wide_candidates(info: &GpuInfo) -> Vec<u32> {
        candidates(&WIDE, Self::standard(info).wide, 1, info)
    }

    /// Pixels of a strip that a lane may hold at once. In software all: llvmpipe's loss takes half as long again otherwise.
    pub fn part_candidates(info: &GpuInfo) -> Vec<u32> {
        if info.is_cpu { vec![STRIP] } else { vec![STRIP, SHORT_PART] }
    }

    /// Narrow workgroups and lanes of a share, under the same conditions; those with one lane per share first.
    pub fn narrow_candidates(info: &GpuInfo) -> Vec<(u32, u32)> {
        let sizes = candidates(&NARROW, Self::standard(info).narrow, 1, info);
        // Not in software: barriers cost more there than lanes are worth, and llvmpipe bounds the turns of a loop.
        let groups = sizes.clone().into_iter().filter(|_| !info.is_cpu);
        sizes.into_iter().map(|n| (n, 1)).chain(groups.map(|n| (n, n))).collect()
    }

    /// Tiles of a workgroup, lanes of a tile, Gaussians they fetch and lanes they sum at once, under the same conditions; those with
    /// one lane per tile first.
    pub fn tile_candidates(info: &GpuInfo) -> Vec<(u32, u32, u32, u32)> {
        let usual = if info.is_cpu { 8 } else { 32 };
        let mut all: Vec<_> = candidates(&TILES, usual, 1, info).into_iter().map(|n| (n, 1, 1, 1)).collect();
        if info.shuffles {
            for tiles in candidates(&TILES, 0, RUNS, info) {
                all.extend([(1, 1), (1, RUNS), (RUNS, 1), (RUNS, RUNS)].map(|(f, s)| (tiles, RUNS, f, s)));
            }
        }
        // Not in software: barriers cost more there than lanes are worth.
        let meeting = if info.shuffles { &MEETING_TILES[..1] } else { &MEETING_TILES };
        let standard = Self::standard(info).tiles;
        for tiles in candidates(meeting, standard, RUNS, info).into_iter().filter(|_| !info.is_cpu) {
            all.extend([1, RUNS].map(|s| (tiles, RUNS, 1, s)));
        }
        all
    }

    /// Whether the kernels are written for this configuration and the device can run it.
    pub fn fits(&self, info: &GpuInfo) -> bool {
        let sizes = WIDE.contains(&self.wide) && NARROW.contains(&self.narrow);
        let runs = match self.tile_lanes {
            1 => TILES.contains(&self.tiles),
            RUNS if self.meets(info) => MEETING_TILES.contains(&self.tiles) && self.fetched == 1,
            RUNS => TILES.contains(&self.tiles),
            _ => false,
        };
        let at_once = [self.fetched, self.summed].iter().all(|n| *n == 1 || *n == self.tile_lanes);
        let shares = self.share_lanes == 1 || (self.share_lanes == self.narrow && !info.is_cpu);
        let part = self.part == STRIP || self.part == SHORT_PART;
        sizes && runs && at_once && shares && part && self.largest_workgroup() <= info.limits.workgroup_lanes
    }

    /// Whether the lanes of a tile meet in shared memory, where there are several.
    pub(crate) fn meets(&self, info: &GpuInfo) -> bool {
        !info.shuffles || self.tiles == MEETING_TILES[0]
    }

    /// Lanes of its largest workgroup.
    pub(crate) fn largest_workgroup(&self) -> u32 {
        self.wide.max(self.narrow).max(self.tiles.saturating_mul(self.tile_lanes))
    }
}

/// As `config::kernels::VARIABLE` takes it.
impl fmt::Display for KernelConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part } = self;
        write!(f, "{wide}x{narrow}x{share_lanes}x{tiles}x{tile_lanes}x{fetched}x{summed}x{part}")
    }
}

/// A number that changes whenever any kernel does: a configuration measured with other kernels says nothing about these.
pub fn kernels_fingerprint() -> u64 {
    crate::kernels::fingerprint(&crate::processor::SOURCES)
}

/// Sizes whose workgroups of `lanes` each the device can run; less than a subgroup leaves lanes idle.
fn candidates(sizes: &[u32], standard: u32, lanes: u32, info: &GpuInfo) -> Vec<u32> {
    let usable = |n: u32| n * lanes <= info.limits.workgroup_lanes && n * lanes >= info.subgroup_size;
    sizes.iter().copied().filter(|n| *n == standard || usable(*n)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::DeviceLimits;
    use config::plan::Lanes;

    fn device(is_cpu: bool, subgroup_size: u32, workgroup_lanes: u32) -> GpuInfo {
        GpuInfo {
            name: "device".into(),
            version: (1, 1),
            is_cpu,
            is_integrated: true,
            subgroup_size,
            shuffles: subgroup_size >= 16,
            heap_bytes: 1 << 30,
            ids: (1, 2),
            driver_version: 3,
            limits: DeviceLimits { workgroup_lanes, texel_elements: 1 << 27, storage_buffers: 8 },
        }
    }

    #[test]
    fn candidates_respect_the_limits_and_fill_subgroups() {
        let lavapipe = device(true, 8, 1024);
        assert_eq!(KernelConfig::wide_candidates(&lavapipe), WIDE);
        assert_eq!(KernelConfig::narrow_candidates(&lavapipe), NARROW.map(|n| (n, 1)));
        let pi5 = device(false, 16, 256);
        assert_eq!(KernelConfig::narrow_candidates(&pi5), [(16, 1), (32, 1), (16, 16), (32, 32)]);
        let turnip = device(false, 128, 1024);
        assert_eq!(KernelConfig::wide_candidates(&turnip), [64, 128, 256]);
        assert_eq!(KernelConfig::narrow_candidates(&turnip), [(32, 1), (32, 32)], "the standard one remains");
        assert_eq!(KernelConfig::wide_candidates(&device(false, 32, 128)), [32, 64, 128]);
    }

    #[test]
    fn several_lanes_per_tile_fetch_for_each_other_only_where_they_can_read_each_other() {
        assert_eq!(KernelConfig::tile_candidates(&device(true, 8, 1024)), [(8, 1, 1, 1), (16, 1, 1, 1), (32, 1, 1, 1)]);
        let pi5 = device(false, 16, 256);
        let at_once = [(1, 1), (1, 8), (8, 1), (8, 8)];
        let runs: Vec<_> = [8, 16, 32].into_iter().flat_map(|n| at_once.map(|(f, s)| (n, 8, f, s))).collect();
        let met = [(2, 8, 1, 1), (2, 8, 1, 8)];
        assert_eq!(KernelConfig::tile_candidates(&pi5), [&[(16, 1, 1, 1), (32, 1, 1, 1)], &runs[..], &met].concat());
        assert_eq!(KernelConfig::tile_candidates(&device(false, 64, 1024)), [&[(32, 1, 1, 1)], &runs[..]].concat());
        // A Raspberry Pi 4: they meet in shared memory.
        let pi4 = GpuInfo { shuffles: false, ..pi5.clone() };
        let meeting = [2, 8].into_iter().flat_map(|n| [1, 8].map(|s| (n, 8, 1, s)));
        let meeting: Vec<_> = [(16, 1, 1, 1), (32, 1, 1, 1)].into_iter().chain(meeting).collect();
        assert_eq!(KernelConfig::tile_candidates(&pi4), meeting);
        let (wide, narrow, share_lanes, tiles, tile_lanes) = (64, 32, 32, 8, 8);
        let runs = KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, fetched: 8, summed: 1, part: 2 };
        assert!(runs.fits(&pi5) && !runs.fits(&pi4));
        assert!(
            KernelConfig { fetched: 1, ..runs }.fits(&pi4)
                && !KernelConfig { fetched: 1, tiles: 16, ..runs }.fits(&pi4)
        );
        let two = KernelConfig { fetched: 1, tiles: 2, ..runs };
        assert!(two.fits(&pi5) && two.meets(&pi5) && !runs.meets(&pi5));
        assert!(!KernelConfig { tile_lanes: 1, summed: 1, ..two }.fits(&pi5), "too few lanes");
        assert!(!KernelConfig { tile_lanes: 2, ..runs }.fits(&pi5));
        assert!(!KernelConfig { fetched: 2, ..runs }.fits(&pi5));
        assert!(!KernelConfig { summed: 2, ..runs }.fits(&pi5));
        assert!(!KernelConfig { tile_lanes: 1, ..runs }.fits(&pi5), "nobody to fetch for");
        assert!(!KernelConfig { share_lanes: 16, ..runs }.fits(&pi5));
        assert!(!KernelConfig { part: 4, ..runs }.fits(&pi5));
        assert_eq!(runs.to_string(), "64x32x32x8x8x8x1x2");
    }

    #[test]
    fn a_gpu_begins_with_a_lane_per_run_and_a_processor_with_one_per_tile() {
        let lanes = |info: &GpuInfo| (KernelConfig::standard(info).tiles, KernelConfig::standard(info).tile_lanes);
        assert_eq!(lanes(&device(false, 16, 256)), (8, RUNS));
        assert_eq!(lanes(&device(false, 4, 256)), (2, RUNS), "no shuffles");
        assert_eq!(lanes(&GpuInfo { shuffles: false, ..device(false, 128, 256) }), (8, RUNS));
        assert_eq!(lanes(&device(true, 16, 1024)), (8, 1));
        let no_shuffles = [4, 16, 128].map(|n| GpuInfo { shuffles: false, ..device(false, n, 256) });
        let others = [device(false, 16, 64), device(false, 16, 256), device(true, 8, 1024), device(false, 64, 128)];
        for info in no_shuffles.into_iter().chain(others) {
            assert!(KernelConfig::standard(&info).fits(&info));
            let listed = KernelConfig::tile_candidates(&info);
            let KernelConfig { tiles, tile_lanes, fetched, summed, .. } = KernelConfig::standard(&info);
            assert!(listed.contains(&(tiles, tile_lanes, fetched, summed)), "{info:?}");
        }
    }

    #[test]
    fn sums_over_a_tile_begin_as_the_compiler_of_the_device_spills_least() {
        let of = |vendor: u32, is_integrated: bool| {
            let info = GpuInfo { ids: (vendor, 2), is_integrated, ..device(false, 16, 256) };
            KernelConfig::standard(&info).summed
        };
        let (mali, adreno, nvidia) = (0x13b5, 0x5143, 0x10de);
        assert_eq!([of(mali, true), of(adreno, true), of(BROADCOM, true), of(nvidia, false)], [1, 1, RUNS, RUNS]);
        let pi4 = GpuInfo { ids: (BROADCOM, 2), shuffles: false, ..device(false, 16, 256) };
        assert_eq!(KernelConfig::standard(&pi4).summed, RUNS);
    }

    #[test]
    fn every_candidate_fits_and_divides_the_lanes_of_the_loops() {
        for info in [device(true, 8, 1024), device(false, 64, 256), device(false, 4, 128)] {
            let (wide, narrow) = (KernelConfig::wide_candidates(&info), KernelConfig::narrow_candidates(&info));
            let tiles = KernelConfig::tile_candidates(&info);
            for (wide, (narrow, share_lanes)) in wide.iter().flat_map(|w| narrow.iter().map(|n| (*w, *n))) {
                assert!(tiles.iter().copied().all(|(tiles, tile_lanes, fetched, summed)| {
                    [2, STRIP].into_iter().all(|part| {
                        KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part }.fits(&info)
                    })
                }));
                for Lanes { sort, loops } in [Lanes::SOFTWARE, Lanes::BOARD, Lanes::CARD] {
                    assert_eq!((loops % wide, sort % narrow), (0, 0));
                }
            }
        }
        let info = device(false, 32, 128);
        for (wide, narrow, tiles) in
            [(256, 32, 8), (64, 0, 8), (48, 32, 8), (64, 64, 8), (0, 8, 8), (64, 8, 9), (64, 8, 0), (64, 8, u32::MAX)]
        {
            let one = KernelConfig::standard(&device(true, 8, 128));
            let config = KernelConfig { wide, narrow, tiles, ..one };
            assert!(!config.fits(&info), "{config}");
        }
    }
}
