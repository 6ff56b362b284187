//! What a scene larger than the device takes in its file: cells of ground, each in blocks of records.

use super::{Plan, SECTION_ALIGNMENT, sh_columns};

/// Gaussians of a block of the file; a cell owns whole blocks. Some 20 KiB: large enough that a disk reads them at its pace, small
/// beside a cell.
pub const BLOCK_GAUSSIANS: usize = 32;
/// Gaussians of a cell that its last block may leave empty on average: bounds how many cells there may be.
const LEAST_GAUSSIANS_PER_CELL: usize = 4 * BLOCK_GAUSSIANS;
/// Even a small scene is worth so many cells: some 10 MiB of the file.
const LEAST_CELLS: usize = 256;
/// More of them would take longer to choose from than they spare.
const MOST_CELLS: usize = 16 << 10;
/// Bytes on the host per cell: key, bounds, blocks, and the lists of a window (112), and a tree of as many keys while the scene is divided
/// (40: entries of 16 in nodes that are half full).
const CELL_BYTES: u64 = 152;
/// Bytes on the host per Gaussian on the device: its cell, the order in which it is written, whether it left a hole, and where it was
/// before something was drawn.
const TAG_BYTES: u64 = 16;

impl Plan {
    /// Whether there may be more Gaussians than the device holds at once.
    pub fn is_paged(&self) -> bool {
        self.scene > self.gaussians
    }

    /// Cells of ground that the scene is divided into at most.
    pub fn cells(&self) -> usize {
        if self.is_paged() { (self.scene / LEAST_GAUSSIANS_PER_CELL).clamp(LEAST_CELLS, MOST_CELLS) } else { 0 }
    }

    /// Bytes of one Gaussian with Adam's moments, in the arena and in the file alike.
    pub fn record_bytes(&self) -> usize {
        let sh = 16 * sh_columns(self.sh_degree) as usize;
        144 + sh + if self.half_moments { sh } else { 2 * sh }
    }

    /// Blocks of the scene's file.
    pub fn scene_blocks(&self) -> usize {
        if self.is_paged() { self.scene.div_ceil(BLOCK_GAUSSIANS) + self.cells() } else { 0 }
    }

    /// Bytes of the file that holds the cells which are not on the device; 0 when all Gaussians always are.
    pub fn scene_file_bytes(&self) -> u64 {
        (self.scene_blocks() * BLOCK_GAUSSIANS * self.record_bytes()) as u64
    }

    /// Bytes of the host's lists of cells and of a window.
    pub fn scene_lists_bytes(&self) -> u64 {
        match self.is_paged() {
            true => {
                let block = (BLOCK_GAUSSIANS * self.record_bytes()) as u64;
                (self.cells() as u64 * CELL_BYTES + 4 * self.scene_blocks() as u64 + TAG_BYTES * self.gaussians as u64)
                    .next_multiple_of(SECTION_ALIGNMENT)
                    + block
            }
            false => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::plan::PlanRequest;

    use super::*;

    #[test]
    fn a_scene_of_five_million_has_a_plan_in_512_mib_and_a_file_for_the_rest() {
        let request = PlanRequest { scene_gaussians: Some(5_000_000), half_moments: true, ..PlanRequest::default() };
        let plan = Plan::new(&request).unwrap();
        assert!(plan.is_paged() && plan.total_bytes <= 512 << 20);
        assert_eq!(plan.record_bytes(), 144 + 192 + 192);
        let blocks = 5_000_000usize.div_ceil(BLOCK_GAUSSIANS) + plan.cells();
        assert_eq!(plan.scene_file_bytes(), (blocks * BLOCK_GAUSSIANS * 528) as u64);
        assert!(plan.scene_file_bytes() < 5_000_000 * 528 * 5 / 4 + (1 << 20));
    }

    #[test]
    fn a_scene_that_fits_the_device_takes_no_file_and_no_lists() {
        for scene_gaussians in [None, Some(1), Some(1000)] {
            let request = PlanRequest { scene_gaussians, max_gaussians: Some(1000), ..PlanRequest::default() };
            let plan = Plan::new(&request).unwrap();
            assert_eq!((plan.scene, plan.scene_file_bytes(), plan.scene_lists_bytes()), (1000, 0, 0));
        }
        let none = PlanRequest { scene_gaussians: Some(0), ..PlanRequest::default() };
        assert!(Plan::new(&none).unwrap_err().to_string().contains("scene_gaussians = 0"));
    }
}
