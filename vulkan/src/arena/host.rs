//! The plan in the host's own memory, where the processor is the device.

use crate::gpu::GpuError;
use rustix::mm::{MapFlags, ProtFlags, mmap_anonymous, munmap};
use std::ffi::c_void;

/// One mapping of zeros, present from its first page to its last.
pub(super) struct HostMemory {
    first: *mut c_void,
    bytes: usize,
}

// SAFETY: it owns what it points to; who reads and writes there answers for it.
unsafe impl Send for HostMemory {}

impl Drop for HostMemory {
    fn drop(&mut self) {
        // SAFETY: mapped with this size, and unmapped once; what refers to it is dropped before.
        let _ = unsafe { munmap(self.first, self.bytes) };
    }
}

impl HostMemory {
    /// # Errors
    /// [`GpuError::OutOfMemory`].
    pub fn new(bytes: u64) -> Result<Self, GpuError> {
        let refused = || GpuError::OutOfMemory { bytes };
        let size = usize::try_from(bytes).map_err(|_| refused())?.max(1);
        // Present now: pages that are only promised may not be there in the middle of a flight.
        let flags = MapFlags::PRIVATE | MapFlags::POPULATE;
        // SAFETY: a new mapping at an address of the system's choice; nobody else has it.
        let mapped = unsafe { mmap_anonymous(std::ptr::null_mut(), size, ProtFlags::READ | ProtFlags::WRITE, flags) };
        Ok(Self { first: mapped.map_err(|_| refused())?, bytes: size })
    }

    /// Its first byte, at a page's beginning.
    pub fn first(&self) -> *mut u8 {
        self.first.cast()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_zero_and_refused_where_there_is_not_so_much() {
        let memory = HostMemory::new(1 << 20).unwrap();
        assert!(memory.first().addr().is_multiple_of(256));
        // SAFETY: mapped above.
        assert!(unsafe { std::slice::from_raw_parts(memory.first(), 1 << 20) }.iter().all(|b| *b == 0));
        assert_eq!(HostMemory::new(u64::MAX >> 2).err(), Some(GpuError::OutOfMemory { bytes: u64::MAX >> 2 }));
    }
}
