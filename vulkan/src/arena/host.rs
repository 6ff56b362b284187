//! The plan in the host's own memory, where the processor is the device.

use crate::gpu::GpuError;
use config::plan::SECTION_ALIGNMENT;
use std::alloc::{Layout, alloc_zeroed, dealloc};
use std::ptr::NonNull;

/// One allocation of zeros, present from its first page to its last.
pub(super) struct HostMemory {
    first: NonNull<u8>,
    layout: Layout,
}

// SAFETY: it owns what it points to; who reads and writes there answers for it.
unsafe impl Send for HostMemory {}

impl Drop for HostMemory {
    fn drop(&mut self) {
        // SAFETY: allocated with this layout, and freed once.
        unsafe { dealloc(self.first.as_ptr(), self.layout) };
    }
}

impl HostMemory {
    /// # Errors
    /// [`GpuError::OutOfMemory`].
    pub fn new(bytes: u64) -> Result<Self, GpuError> {
        let refused = || GpuError::OutOfMemory { bytes };
        let size = usize::try_from(bytes).map_err(|_| refused())?.max(1);
        let layout = Layout::from_size_align(size, SECTION_ALIGNMENT as usize).map_err(|_| refused())?;
        // SAFETY: the layout is not empty.
        let first = NonNull::new(unsafe { alloc_zeroed(layout) }).ok_or_else(refused)?;
        // Written now: pages that are only promised may not be there in the middle of a flight.
        // SAFETY: as many bytes as were allocated.
        unsafe { std::ptr::write_bytes(first.as_ptr(), 0, size) };
        // A compiler may leave out an allocation that it sees nobody read.
        let first = std::hint::black_box(first);
        Ok(Self { first, layout })
    }

    pub fn first(&self) -> *mut u8 {
        self.first.as_ptr()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_zero_aligned_and_refused_where_there_is_not_so_much() {
        let memory = HostMemory::new(1 << 20).unwrap();
        assert!(memory.first().cast::<u64>().is_aligned() && memory.first().addr().is_multiple_of(256));
        // SAFETY: allocated above.
        assert!(unsafe { std::slice::from_raw_parts(memory.first(), 1 << 20) }.iter().all(|b| *b == 0));
        assert_eq!(HostMemory::new(u64::MAX >> 2).err(), Some(GpuError::OutOfMemory { bytes: u64::MAX >> 2 }));
    }
}
