//! Range coding with adaptive counts. One [`Coder`] serves both directions, so that what is written and what is read follow
//! the same lines of code: an encoder codes the symbol it is given, a decoder ignores it and returns the one it reads.

use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};
use constriction::stream::queue::{DefaultRangeDecoder, DefaultRangeEncoder};
use constriction::stream::{Decode, Encode};
use std::borrow::Borrow;
use std::num::NonZeroU32;

/// Bits of the coder's probabilities (constriction's default).
const PRECISION: usize = 24;
/// What a symbol that was seen adds to its count; counts begin at a fraction of that.
const SEEN: u32 = 32;
/// Counts are halved when they add up to more: what was seen lately weighs more, and no probability rounds to zero.
const MAX_TOTAL: u32 = 1 << 20;
/// Residuals up to this size have a symbol each; beyond it their power of two has, and the rest follows as bits.
const DIRECT: u32 = 24;
/// Powers of two beyond [`DIRECT`].
const POWERS: u32 = 21;

/// The stream is not one that an encoder wrote.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("its coded Gaussians make no sense")]
pub struct Garbled;

/// Adaptive counts of the symbols 0..K in one context.
#[derive(Clone, Debug)]
pub struct Counts {
    counts: Vec<u32>,
    total: u32,
}

impl Counts {
    /// Counts to begin with, at least 1 each, at least two symbols.
    pub fn new(first: impl IntoIterator<Item = u32>) -> Self {
        let counts: Vec<u32> = first.into_iter().collect();
        let total = counts.iter().sum();
        Self { counts, total }
    }

    /// `symbols` equally likely ones.
    pub fn even(symbols: usize) -> Self {
        Self::new(std::iter::repeat_n(SEEN / 3, symbols))
    }

    fn saw(&mut self, symbol: usize) {
        self.counts[symbol] += SEEN;
        self.total += SEEN;
        if self.total > MAX_TOTAL {
            self.counts.iter_mut().for_each(|c| *c = c.div_ceil(2));
            self.total = self.counts.iter().sum();
        }
    }
}

/// Share [from, from + count) of `total` as the coder's integers.
fn share(from: u32, count: u32, total: u32) -> Option<(u32, NonZeroU32)> {
    let scaled = |c: u32| ((u64::from(c) << PRECISION) / u64::from(total)) as u32;
    let left = scaled(from);
    NonZeroU32::new(scaled(from + count) - left).map(|p| (left, p))
}

/// The smallest end of a share that lies beyond `quantile`.
fn beyond(quantile: u32, total: u32) -> u32 {
    ((u64::from(quantile) + 1) * u64::from(total)).div_ceil(1 << PRECISION) as u32
}

impl EntropyModel<PRECISION> for &Counts {
    type Symbol = u32;
    type Probability = u32;
}

impl EncoderModel<PRECISION> for &Counts {
    fn left_cumulative_and_probability(&self, symbol: impl Borrow<u32>) -> Option<(u32, NonZeroU32)> {
        let symbol = *symbol.borrow() as usize;
        let count = *self.counts.get(symbol)?;
        share(self.counts[..symbol].iter().sum(), count, self.total)
    }
}

impl DecoderModel<PRECISION> for &Counts {
    fn quantile_function(&self, quantile: u32) -> (u32, u32, NonZeroU32) {
        let end = beyond(quantile, self.total);
        let (mut symbol, mut from) = (0, 0);
        while symbol + 1 < self.counts.len() && from + self.counts[symbol] < end {
            from += self.counts[symbol];
            symbol += 1;
        }
        let (left, probability) = share(from, self.counts[symbol], self.total).unwrap_or((0, NonZeroU32::MIN));
        (symbol as u32, left, probability)
    }
}

/// `.0` equally likely numbers, at most 2²⁴.
#[derive(Clone, Copy)]
struct Even(u32);

impl EntropyModel<PRECISION> for Even {
    type Symbol = u32;
    type Probability = u32;
}

impl EncoderModel<PRECISION> for Even {
    fn left_cumulative_and_probability(&self, symbol: impl Borrow<u32>) -> Option<(u32, NonZeroU32)> {
        let symbol = *symbol.borrow();
        if symbol < self.0 { share(symbol, 1, self.0) } else { None }
    }
}

impl DecoderModel<PRECISION> for Even {
    fn quantile_function(&self, quantile: u32) -> (u32, u32, NonZeroU32) {
        let symbol = beyond(quantile, self.0) - 1;
        let (left, probability) = share(symbol, 1, self.0).unwrap_or((0, NonZeroU32::MIN));
        (symbol, left, probability)
    }
}

/// Either direction.
pub trait Coder {
    /// A symbol of `counts`, which learn it.
    fn symbol(&mut self, counts: &mut Counts, symbol: u32) -> Result<u32, Garbled>;

    /// One of `size` equally likely numbers; `size` is at most 2²⁴.
    fn even(&mut self, size: u32, value: u32) -> Result<u32, Garbled>;

    /// `bits` bits, at most 64.
    fn bits(&mut self, bits: u32, value: u64) -> Result<u64, Garbled> {
        let (mut read, mut left) = (0, bits);
        while left > 0 {
            let now = left.min(16);
            left -= now;
            let part = (value >> left) & ((1 << now) - 1);
            read = read << now | u64::from(self.even(1 << now, part as u32)?);
        }
        Ok(read)
    }

    /// A number as it is.
    fn f32(&mut self, value: f32) -> Result<f32, Garbled> {
        Ok(f32::from_bits(self.bits(32, u64::from(value.to_bits()))? as u32))
    }
}

/// Writes.
pub struct Encoder(DefaultRangeEncoder);

impl Encoder {
    pub fn new() -> Self {
        Self(DefaultRangeEncoder::new())
    }

    /// What was coded.
    pub fn finish(self) -> Vec<u32> {
        self.0.into_compressed().unwrap_or_else(|never| match never {})
    }
}

impl Coder for Encoder {
    fn symbol(&mut self, counts: &mut Counts, symbol: u32) -> Result<u32, Garbled> {
        self.0.encode_symbol(symbol, &*counts).map_err(|_| Garbled)?;
        counts.saw(symbol as usize);
        Ok(symbol)
    }

    fn even(&mut self, size: u32, value: u32) -> Result<u32, Garbled> {
        if size > 1 {
            self.0.encode_symbol(value, Even(size)).map_err(|_| Garbled)?;
        }
        Ok(value)
    }
}

/// Reads.
pub struct Decoder(DefaultRangeDecoder);

impl Decoder {
    pub fn new(words: Vec<u32>) -> Self {
        Self(DefaultRangeDecoder::from_compressed(words).unwrap_or_else(|never| match never {}))
    }
}

impl Coder for Decoder {
    fn symbol(&mut self, counts: &mut Counts, _: u32) -> Result<u32, Garbled> {
        let symbol = self.0.decode_symbol(&*counts).map_err(|_| Garbled)?;
        counts.saw(symbol as usize);
        Ok(symbol)
    }

    fn even(&mut self, size: u32, _: u32) -> Result<u32, Garbled> {
        if size <= 1 { Ok(0) } else { self.0.decode_symbol(Even(size)).map_err(|_| Garbled) }
    }
}

/// Signed numbers near zero, in contexts that learn apart.
pub struct Residuals(Vec<Counts>);

impl Residuals {
    /// `contexts` of them; `sharp`: nearly all are expected to be zero.
    pub fn new(contexts: usize, sharp: bool) -> Self {
        let first = |size: u32| match (sharp, size) {
            (false, 0..6) => [48, 32, 20, 12, 8, 5][size as usize],
            (true, 0..2) => [32, 3][size as usize],
            _ => 1,
        };
        let direct = (0..=2 * DIRECT).map(|s| first(unfold(s).unsigned_abs()));
        let counts = Counts::new(direct.chain(std::iter::repeat_n(1, 2 * POWERS as usize)));
        Self(vec![counts; contexts])
    }

    /// Codes `value` in `context`; beyond ±2²⁰ it is held there.
    pub fn code(&mut self, coder: &mut impl Coder, context: usize, value: i32) -> Result<i32, Garbled> {
        let value = value.clamp(-(1 << 20), 1 << 20);
        let size = value.unsigned_abs();
        let counts = &mut self.0[context];
        let excess = size.saturating_sub(DIRECT);
        let symbol = if excess == 0 { fold(value) } else { 2 * DIRECT + 1 + 2 * excess.ilog2() + u32::from(value < 0) };
        let symbol = coder.symbol(counts, symbol)?;
        let Some(large) = symbol.checked_sub(2 * DIRECT + 1) else { return Ok(unfold(symbol)) };
        let power = large / 2;
        let rest = coder.bits(power, u64::from(excess) & ((1 << power) - 1))? as u32;
        let size = (DIRECT + (1 << power | rest)) as i32;
        Ok(if large % 2 == 1 { -size } else { size })
    }
}

/// 0, -1, 1, -2, 2, … as 0, 1, 2, 3, 4, …
fn fold(value: i32) -> u32 {
    if value < 0 { 2 * value.unsigned_abs() - 1 } else { 2 * value as u32 }
}

fn unfold(symbol: u32) -> i32 {
    if symbol % 2 == 1 { -(symbol.div_ceil(2) as i32) } else { (symbol / 2) as i32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn residuals_bits_and_even_numbers_come_back(
            values in proptest::collection::vec((0usize..3, -(1i32 << 20)..=1 << 20, any::<u64>(), 1u32..1 << 24), 0..200),
        ) {
            let mut encoder = Encoder::new();
            let mut residuals = Residuals::new(3, false);
            for (context, value, bits, size) in &values {
                residuals.code(&mut encoder, *context, *value).unwrap();
                encoder.bits(64, *bits).unwrap();
                encoder.even(*size, size / 3).unwrap();
            }
            let mut decoder = Decoder::new(encoder.finish());
            let mut residuals = Residuals::new(3, false);
            for (context, value, bits, size) in &values {
                prop_assert_eq!(residuals.code(&mut decoder, *context, 0).unwrap(), *value);
                prop_assert_eq!(decoder.bits(64, 0).unwrap(), *bits);
                prop_assert_eq!(decoder.even(*size, 0).unwrap(), size / 3);
            }
        }
    }

    #[test]
    fn a_symbol_that_is_rare_costs_what_its_share_says() {
        let mut encoder = Encoder::new();
        let mut counts = Counts::even(2);
        for i in 0..10_000 {
            encoder.symbol(&mut counts, u32::from(i % 50 == 0)).unwrap();
        }
        // The entropy of one in fifty: 0.1414 bits.
        let bits = 32 * encoder.finish().len();
        assert!((1414..1600).contains(&bits), "{bits}");
    }
}
