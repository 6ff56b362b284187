//! The device's measured rates are rates: positive, finite, and what they say they are.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use vulkan::ceiling::measure;
use vulkan::gpu::Gpu;

#[test]
fn a_device_copies_and_computes_at_rates_that_can_be_divided_by() {
    let gpu = match Gpu::open(None) {
        Ok(gpu) => gpu,
        Err(e) => return println!("skipped: {e}"),
    };
    let ceiling = measure(&gpu).unwrap();
    println!("{ceiling:?}");
    for rate in [ceiling.kernel_bytes_per_s, ceiling.command_bytes_per_s, ceiling.operations_per_s] {
        assert!(rate.is_finite() && rate > 0.0);
    }
    assert!(ceiling.bytes_per_s() >= ceiling.kernel_bytes_per_s);
}
