//! What the device itself can do, measured: bytes moved and multiply-adds per second by kernels that do nothing else.
//! `bench stages` holds every stage's counted work against these two figures.

mod probe;

use crate::gpu::{Gpu, GpuError};
use crate::processor::Rates;
use probe::{Kind, Probe};
use std::time::Instant;

/// Bytes of each of the two buffers that are copied into one another: far beyond any cache of a companion computer.
const BUFFER_BYTES: u64 = 64 << 20;
/// A measurement repeats its kernel until it takes this long, so that submitting costs nothing in comparison.
const LEAST_SECONDS: f64 = 0.04;
/// The best of so many: what else runs on the machine can only make a measurement slower.
const MEASUREMENTS: usize = 5;
/// Lanes of the arithmetic kernel: enough for the widest GPU, short of work for none.
const FMA_LANES: u32 = 1 << 18;
/// Turns of its loop; llvmpipe ends an invocation's loops after 65,535.
const FMA_TURNS: u32 = 64;
/// Operations per turn and lane: 16 chains × 8 unrolled, a multiply and an addition each (`roofline_fma.comp`).
const FMA_PER_TURN: u64 = 16 * 8 * 2;

/// Measured rates of a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Roofline {
    /// Bytes read plus bytes written per second by a kernel that copies.
    pub kernel_bytes_per_s: f64,
    /// Bytes read plus bytes written per second by the device's own copy command, or the processor's.
    pub command_bytes_per_s: f64,
    /// Floating-point operations per second, a fused multiply-add counted as two.
    pub operations_per_s: f64,
}

impl Roofline {
    /// The larger of the two copying rates.
    pub fn bytes_per_s(&self) -> f64 {
        self.kernel_bytes_per_s.max(self.command_bytes_per_s)
    }

    /// Seconds that moving `bytes` and computing `operations` takes at least, both at once.
    pub fn least_seconds(&self, bytes: u64, operations: u64) -> f64 {
        (bytes as f64 / self.bytes_per_s()).max(operations as f64 / self.operations_per_s)
    }
}

/// Measures `gpu`; takes about a second.
///
/// # Errors
/// [`GpuError`], in particular when 128 MiB of device memory cannot be had.
pub fn measure(gpu: &Gpu) -> Result<Roofline, GpuError> {
    let moved = 2 * BUFFER_BYTES;
    let fma = Kind::Fma { lanes: FMA_LANES, turns: FMA_TURNS };
    let operations = u64::from(FMA_LANES) * u64::from(FMA_TURNS) * FMA_PER_TURN;
    let Some(driver) = gpu.vulkan() else {
        let mut rates = Rates::new(gpu, BUFFER_BYTES as usize);
        let mut many = |n: u32, run: &dyn Fn(&mut Rates)| {
            (0..n).for_each(|_| run(&mut rates));
            Ok(())
        };
        return Ok(Roofline {
            kernel_bytes_per_s: rate(moved, |n| many(n, &|rates| rates.copy(false)))?,
            command_bytes_per_s: rate(moved, |n| many(n, &|rates| rates.copy(true)))?,
            operations_per_s: rate(operations, |n| many(n, &|rates| rates.multiply_add(operations)))?,
        });
    };
    let probe = Probe::new(driver, BUFFER_BYTES)?;
    Ok(Roofline {
        kernel_bytes_per_s: rate(moved, |n| probe.run(Kind::CopyKernel, n))?,
        command_bytes_per_s: rate(moved, |n| probe.run(Kind::CopyCommand, n))?,
        operations_per_s: rate(operations, |n| probe.run(fma, n))?,
    })
}

/// Units per second when one run is worth `units`; `run` repeats it so often.
fn rate(units: u64, mut run: impl FnMut(u32) -> Result<(), GpuError>) -> Result<f64, GpuError> {
    let mut timed = |repeats: u32| {
        let start = Instant::now();
        run(repeats)?;
        Ok::<f64, GpuError>(start.elapsed().as_secs_f64().max(1e-9))
    };
    // The first run also compiles.
    timed(1)?;
    let mut repeats = 1;
    while repeats < 1 << 12 && timed(repeats)? < LEAST_SECONDS {
        repeats *= 2;
    }
    let mut best = 0.0f64;
    for _ in 0..MEASUREMENTS {
        best = best.max(units as f64 * f64::from(repeats) / timed(repeats)?);
    }
    Ok(best)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slower_of_moving_and_computing_decides() {
        let c = Roofline { kernel_bytes_per_s: 10.0, command_bytes_per_s: 5.0, operations_per_s: 100.0 };
        assert_eq!(c.least_seconds(100, 100), 10.0);
        assert_eq!(c.least_seconds(10, 1000), 10.0);
    }
}
