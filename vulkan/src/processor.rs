//! The kernels as functions of the processor.
//!
//! Where the device is the processor itself, its memory is the host's and no driver is needed. Each function has the name, the
//! sections and the meaning of its kernel in `shaders/`; the references in `crate::reference` judge both. What a step leaves does not
//! depend on the number of threads, on the vectors of the processor, or on how many bands a picture is done in.

mod blend;
mod gaussians;
mod halves;
mod lanes;
mod loss;
mod memory;
mod optimise;
mod pool;
mod project;
mod projection;
mod rates;
mod target;
#[cfg(test)]
mod tests;
mod tiles;
mod vectors;

use crate::arena::Arena;
use crate::gpu::Gpu;
use crate::kernels::Kernel;
use crate::layout::{Frame, Push, Section};
use config::plan::{Plan, sh_columns};
use fearless_simd::Level;
use gaussians::{Harmonics, Moments, State, columns_up_to};
use memory::Memory;
use pool::{Parts, Pool};
pub(crate) use rates::Rates;

/// The text of these functions: what was measured with other ones says nothing about them.
pub(crate) const SOURCES: [&str; 12] = [
    include_str!("processor/blend.rs"),
    include_str!("processor/gaussians.rs"),
    include_str!("processor/halves.rs"),
    include_str!("processor/lanes.rs"),
    include_str!("processor/loss.rs"),
    include_str!("processor/optimise.rs"),
    include_str!("processor/pool.rs"),
    include_str!("processor/project.rs"),
    include_str!("processor/projection.rs"),
    include_str!("processor/target.rs"),
    include_str!("processor/tiles.rs"),
    include_str!("processor/vectors.rs"),
];

/// Gaussians that a thread takes at once.
const SHARE: usize = 256;

/// A processor that runs kernels, with what is the same in all of them.
pub(crate) struct Processor {
    pool: Pool,
    level: Level,
    plan: Plan,
    own_degrees: bool,
    /// Kernels are left out (a test).
    computes_nothing: bool,
}

impl Processor {
    /// The processor as `gpu` has it.
    pub fn new(gpu: &Gpu, plan: &Plan, own_degrees: bool) -> Self {
        let (threads, level) = gpu.powers();
        let computes_nothing = gpu.computes_nothing();
        Self { pool: Pool::new(threads), level, plan: plan.clone(), own_degrees, computes_nothing }
    }

    /// Zeroes a section's first `bytes` bytes.
    pub fn clear(&self, arena: &Arena, section: Section, bytes: u64) {
        if let Some(arena) = arena.in_place() {
            // SAFETY: the section lies inside the mapping; the device is idle, and nobody else uses the arena.
            unsafe { std::ptr::write_bytes(arena.at(section), 0, bytes.min(section.bytes) as usize) };
        }
    }

    /// Runs `kernel`, with the picture in `slot` where it reads one. The device must be idle, and nobody else must use the arena.
    pub fn run(&self, arena: &Arena, kernel: Kernel, slot: usize, push: Push) {
        let Some(arena) = arena.in_place().filter(|_| !self.computes_nothing) else { return };
        let memory = Memory { arena, plan: &self.plan, slot };
        let frame = &memory.read::<Frame>("frame")[0];
        let call = Call { memory, frame, push, pool: &self.pool, level: self.level, own_degrees: self.own_degrees };
        const BY_KEY: [&str; 2] = ["keys", "order"];
        const OTHER: [&str; 2] = ["keys_other", "order_other"];
        match kernel {
            Kernel::Target => target::target(&call),
            Kernel::Project => project::project(&call),
            Kernel::CatchUp => project::catch_up_sh(&call),
            Kernel::SortCount => tiles::sort_count(&call, BY_KEY[0]),
            Kernel::SortCountOther => tiles::sort_count(&call, OTHER[0]),
            Kernel::SortScan => tiles::sort_scan(&call),
            Kernel::SortScatter => tiles::sort_scatter(&call, BY_KEY, OTHER),
            Kernel::SortScatterBack => tiles::sort_scatter(&call, OTHER, BY_KEY),
            Kernel::Shade => project::shade(&call),
            Kernel::Count => tiles::count(&call),
            Kernel::TilePrefix => tiles::tile_prefix(&call),
            Kernel::TileScan => tiles::tile_scan(&call),
            Kernel::Emit => tiles::emit(&call),
            Kernel::Rasterise => blend::rasterise(&call),
            Kernel::RasteriseMedian => blend::rasterise_median(&call),
            Kernel::DepthSums => loss::depth_sums(&call),
            Kernel::DepthFinish => loss::depth_finish(&call),
            // What these leave for the next one never goes to memory here.
            Kernel::SsimRows | Kernel::SsimColumns => (),
            Kernel::SsimBackRows => loss::ssim_back_rows(&call),
            Kernel::LossGradient => loss::loss_gradient(&call),
            Kernel::ExposureSums => loss::exposure_sums(&call),
            Kernel::RasteriseBackward => blend::rasterise_backward(&call),
            Kernel::RasteriseBackwardDepth => blend::rasterise_backward_depth(&call),
            Kernel::Reduce => optimise::reduce(&call),
            Kernel::OptimiseSh => optimise::optimise_sh(&call),
            Kernel::ProjectBackward => optimise::project_backward(&call),
            Kernel::PoseSums => optimise::pose_sums(&call),
            Kernel::Optimise => optimise::optimise(&call),
        }
    }
}

/// What a kernel is called with.
struct Call<'a> {
    memory: Memory<'a>,
    frame: &'a Frame,
    push: Push,
    pool: &'a Pool,
    level: Level,
    /// Whether Gaussians have SH degrees of their own, or all the plan's.
    own_degrees: bool,
}

impl Call<'_> {
    fn sort_lanes(&self) -> usize {
        self.memory.plan.lanes.sort as usize
    }

    fn loop_lanes(&self) -> usize {
        self.memory.plan.lanes.loops as usize
    }

    /// Shares of all Gaussians, each for one thread.
    fn shares(&self) -> usize {
        (self.frame.gaussians as usize).div_ceil(SHARE)
    }

    /// The Gaussians of a share.
    fn share(&self, share: usize) -> std::ops::Range<usize> {
        share * SHARE..((share + 1) * SHARE).min(self.frame.gaussians as usize)
    }

    /// Highest degree of the plan.
    fn sh_degree(&self) -> u32 {
        self.memory.plan.sh_degree.into()
    }

    /// Columns (four numbers each) of SH that a Gaussian has on the device.
    fn columns(&self) -> usize {
        sh_columns(self.memory.plan.sh_degree) as usize
    }

    /// Numbers of SH that a Gaussian in this state holds.
    fn held(&self, state: State) -> usize {
        let own = if self.own_degrees { columns_up_to(state.degree()) } else { usize::MAX };
        4 * own.min(self.columns())
    }

    /// The degree that a Gaussian in this state is seen with.
    fn degree(&self, state: State) -> u32 {
        let own = if self.own_degrees { state.degree() } else { self.sh_degree() };
        own.min(self.frame.sh_degree)
    }

    /// SH and their moments, to write.
    ///
    /// # Safety
    /// As of [`Memory::write`], for the three sections.
    unsafe fn harmonics(&self) -> Harmonics<'_> {
        let memory = &self.memory;
        // SAFETY: by contract.
        unsafe {
            let moments = match memory.plan.half_moments {
                false => Moments::Whole(
                    Parts::of(memory.write("sh_first_moment")),
                    Parts::of(memory.write("sh_second_moment")),
                ),
                true => Moments::Half(
                    Parts::of(memory.write("sh_first_moment")),
                    Parts::of(memory.write("sh_second_moment")),
                ),
            };
            Harmonics { sh: Parts::of(memory.write("sh")), moments, stride: 4 * self.columns() }
        }
    }
}
