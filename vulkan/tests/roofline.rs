//! The device's measured rates are rates: positive, finite, and what they say they are.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use vulkan::gpu::Gpu;
use vulkan::roofline::measure;

#[test]
fn a_device_copies_and_computes_at_rates_that_can_be_divided_by() {
    let gpu = match Gpu::open(None) {
        Ok(gpu) => gpu,
        Err(e) => return needs::missing(needs::Need::Vulkan, e),
    };
    let roofline = measure(&gpu).unwrap();
    println!("{roofline:?}");
    for rate in [roofline.kernel_bytes_per_s, roofline.command_bytes_per_s, roofline.operations_per_s] {
        assert!(rate.is_finite() && rate > 0.0);
    }
    assert!(roofline.bytes_per_s() >= roofline.kernel_bytes_per_s);
}
