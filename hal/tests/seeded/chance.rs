//! Numbers by chance, the same ones for the same seed, and a shutter's rhythm made of them.

/// Numbers by chance (an LCG with a mixed output).
pub struct Chance(u64);

impl Chance {
    pub fn new(seed: u64) -> Self {
        let mut chance = Self(seed * 7919 + 13);
        (0..5).for_each(|_| {
            chance.unit();
        });
        chance
    }

    /// 0 … 1.
    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let mixed = (self.0 ^ (self.0 >> 33)).wrapping_mul(0xff51_afd7_ed55_8ccd);
        (mixed >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    pub fn yes(&mut self, share: f64) -> bool {
        self.unit() < share
    }

    /// `low`, … `high`.
    pub fn count(&mut self, low: usize, high: usize) -> usize {
        (self.between(low as f64, high as f64 + 1.0) as usize).min(high)
    }

    /// Zero in `share` of all flights.
    pub fn sometimes(&mut self, share: f64, high: f64) -> f64 {
        if self.yes(share) { 0.0 } else { self.between(0.0, high) }
    }
}

/// When a shutter opens.
pub struct Rhythm {
    /// Seconds between two exposures.
    pub interval: f64,
    /// It is always the same; else turns lie between survey lines, and no interval is quite like the next.
    pub regular: bool,
    /// Exposures of one survey line.
    pub line: usize,
}

impl Rhythm {
    /// Times of so many exposures from `begin` on, s.
    pub fn times(&self, chance: &mut Chance, begin: f64, exposures: usize) -> Vec<f64> {
        let mut at = begin;
        let mut times = Vec::with_capacity(exposures);
        for k in 0..exposures {
            times.push(at);
            at += self.interval;
            if !self.regular {
                at += self.interval * chance.between(-0.15, 0.15);
                if k % self.line == self.line - 1 {
                    at += self.interval * chance.between(0.5, 3.0);
                }
            }
        }
        times
    }
}
