//! The sections of the arena as kernels of the processor see them.

use crate::arena::{InPlace, slot_of};
use crate::kernels::part_of_slots;
use crate::layout::Section;
use config::plan::Plan;

/// Where a kernel finds what it reads and writes.
#[derive(Clone, Copy)]
pub(super) struct Memory<'a> {
    pub arena: InPlace<'a>,
    pub plan: &'a Plan,
    /// Slot of the view, where the kernel reads one.
    pub slot: usize,
}

impl<'a> Memory<'a> {
    fn section(&self, name: &str) -> Section {
        match name {
            "view" => slot_of(self.arena.section("views"), self.plan, self.slot),
            name => part_of_slots(name, self.arena.section("slots"), self.plan.pixels)
                .unwrap_or_else(|| self.arena.section(name)),
        }
    }

    /// The section `name`, to read.
    pub fn read<T: bytemuck::AnyBitPattern>(&self, name: &str) -> &'a [T] {
        let section = self.section(name);
        // SAFETY: as in `write`; kernels that write a section do not read it otherwise.
        unsafe {
            std::slice::from_raw_parts(self.arena.at(section).cast::<T>(), section.bytes as usize / size_of::<T>())
        }
    }

    /// The section `name`, to write.
    ///
    /// # Safety
    /// The device is idle, and nobody has this section otherwise for as long as the result is used.
    pub unsafe fn write<T: bytemuck::AnyBitPattern + bytemuck::NoUninit>(&self, name: &str) -> &'a mut [T] {
        let section = self.section(name);
        // SAFETY: sections lie inside the mapping, are 256-byte aligned (a part of one at least 16), and T is plain data; that nobody
        // else has this one is the contract.
        unsafe {
            std::slice::from_raw_parts_mut(self.arena.at(section).cast::<T>(), section.bytes as usize / size_of::<T>())
        }
    }
}
