//! Stage *target*: the step's picture at working size (`shaders/target.comp`).

use super::Call;
use super::pool::Parts;
use crate::layout;
use fearless_simd::dispatch;

/// In place of a confidence: the pixel is left out of every comparison.
pub(super) const LEFT_OUT: u32 = layout::LEFT_OUT as u32;

/// Blocks of `divisor` × `divisor` pixels averaged; the depth is weighted by its confidence, which is alpha. Pixels that are left out have
/// no part in it, and a block of them is left out.
pub(super) fn target(call: &Call<'_>) {
    let (frame, memory) = (call.frame, &call.memory);
    let (view, first) = (memory.read::<u32>("view"), call.push.first as usize);
    // SAFETY: the only section that this kernel writes.
    let target = Parts::of(unsafe { memory.write::<[u32; 2]>("target") });
    let [width, height] = frame.size.map(|n| n as usize);
    let (divisor, source_width) = (frame.divisor as usize, frame.source_width as usize);
    let depths = (frame.depth_offset != 0).then_some(frame.depth_offset as usize);
    let row_of = |y: usize| {
        // SAFETY: a row of the picture for each part.
        let row = unsafe { target.range(y * width, width) };
        let start = first + y * divisor * source_width;
        if divisor == 1 {
            for (x, (out, texel)) in row.iter_mut().zip(&view[start..start + width]).enumerate() {
                let depth =
                    depths.filter(|_| texel >> 24 > LEFT_OUT).map_or(0, |first| depth_of(&view[first..], start + x));
                *out = [if texel >> 24 == LEFT_OUT { LEFT_OUT << 24 } else { *texel }, depth as u32];
            }
            return;
        }
        for (x, out) in row.iter_mut().enumerate() {
            let corner = start + x * divisor;
            let mut block = Block::default();
            for line in 0..divisor {
                for at in corner + line * source_width..corner + line * source_width + divisor {
                    block.add(view[at], || depths.map_or(0, |first| depth_of(&view[first..], at)));
                }
            }
            *out = block.mean();
        }
    };
    call.pool.each(height, |y| dispatch!(call.level, _s => row_of(y)));
}

/// Depth `at` of two in a word.
fn depth_of(depths: &[u32], at: usize) -> u64 {
    u64::from(depths[at / 2] >> (16 * (at % 2)) & 0xFFFF)
}

/// Sums over a block of pixels, exact.
#[derive(Default)]
struct Block {
    seen: u32,
    /// Red, green, blue, confidence.
    sums: [u32; 4],
    /// Of depths times confidences.
    depth: u64,
}

impl Block {
    fn add(&mut self, texel: u32, depth: impl FnOnce() -> u64) {
        let channels = texel.to_le_bytes();
        if u32::from(channels[3]) == LEFT_OUT {
            return;
        }
        self.seen += 1;
        for (sum, c) in self.sums.iter_mut().zip(channels) {
            *sum += u32::from(c);
        }
        if channels[3] > 0 {
            self.depth += u64::from(channels[3]) * depth();
        }
    }

    /// A texel and its depth.
    fn mean(&self) -> [u32; 2] {
        if self.seen == 0 {
            return [LEFT_OUT << 24, 0];
        }
        // Exact: a mean of so few whole numbers below 256 is never so close to a half that its rounding matters.
        let [r, g, b, mut a] = self.sums.map(|sum| (sum as f32 / self.seen as f32 + 0.5) as u32);
        let depth = if self.sums[3] > 0 { (self.depth as f64 / f64::from(self.sums[3]) + 0.5) as u32 } else { 0 };
        // A mean confidence that reads as the mark is next to none.
        if a == LEFT_OUT {
            a = 0;
        }
        [r | g << 8 | b << 16 | a << 24, depth]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_is_the_mean_of_what_is_kept_of_it_and_left_out_where_nothing_is() {
        let texel = |r: u32, a: u32| r | a << 24;
        let mut block = Block::default();
        for (r, a, depth) in [(10, 255, 100), (21, 0, 9000), (99, LEFT_OUT, 7), (11, 255, 301)] {
            block.add(texel(r, a), || depth);
        }
        assert_eq!(block.mean(), [texel(14, 170), 201], "42 / 3, 510 / 3, the confident depths' mean");
        let mut none = Block::default();
        none.add(texel(3, LEFT_OUT), || 5);
        assert_eq!(none.mean(), [LEFT_OUT << 24, 0]);
        let mut mark = Block::default();
        mark.add(texel(1, 2), || 8);
        mark.add(texel(1, 0), || 8);
        assert_eq!(mark.mean(), [texel(1, 0), 8], "a mean that reads as the mark");
    }
}
