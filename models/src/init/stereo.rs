//! Depth of a picture from posed neighbours, without learned weights and without a runtime library: a plane sweep scored by
//! normalised correlation and regularised by semi-global matching (Hirschmüller, "Stereo processing by semiglobal matching
//! and mutual information", PAMI 2008).
//!
//! Everything is counted in square cells of one or more pixels. Stages, in the order of the work:
//! 1. [`features`]: luminance of each picture, normalised by its local mean and deviation;
//! 2. [`volume`]: for each of [`PLANES`] inverse depths the cost of each cell, from the two sources that agree best;
//! 3. [`semi_global`]: costs summed along eight paths, with penalties for steps in depth;
//! 4. [`winner`]: the cheapest plane of each cell, its place between planes, and how sure it is.

mod features;
mod semi_global;
#[cfg(test)]
mod tests;
mod volume;
mod winner;

use image::RgbImage;

use features::Features;
use semi_global::Paths;
use volume::{Inverse, Volume};

/// Inverse depths that are compared, evenly spaced over the range.
const PLANES: usize = 64;
/// Pictures that a picture is compared with at most.
pub const SOURCES: usize = 4;
/// Pictures with a longer side, pixels, are matched at half their size, others at their own.
const LARGE: u32 = 512;
/// So are strips of fewer rows or columns: half of one pixel is no cell.
const NARROW: u32 = 16;
/// What a correlation of 1 is worth in costs.
const UNIT: i32 = 128;

/// How much of what a cell's own windows say is believed, and how much of what its surroundings say.
#[derive(Clone, Copy, Debug)]
struct Smoothness {
    /// Penalty of a change by one plane, as a correlation.
    small_step: f32,
    /// Penalty of a larger one where the picture shows no edge.
    large_step: f32,
    /// Share of the larger window.
    large_window: f32,
}

impl Smoothness {
    /// For a number of sources: few agree by chance, many know edges in depth better than their surroundings do.
    fn of(sources: usize) -> Self {
        let (small_step, large_step, large_window) = match sources {
            ..3 => (1.0, 20.0, 0.5),
            3 => (0.5, 5.0, 0.3),
            _ => (0.3, 2.5, 0.2),
        };
        Self { small_step, large_step, large_window }
    }
}

/// A picture that another one is compared with.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// Its pixels.
    pub image: &'a RgbImage,
    /// 4 × 4, row-major, with pixel centres at whole numbers: a pixel (x, y) of the reference at the inverse depth w lies at
    /// M·(x, y, 1, w).
    pub projection: [f32; 16],
}

/// Depth and confidence of each cell of a picture.
#[derive(Clone, Copy, Debug)]
pub struct Depths<'a> {
    /// Columns.
    pub width: usize,
    /// Side of a cell, pixels.
    pub cell: usize,
    /// Along the optical axis, in the unit of the range.
    pub depth: &'a [f32],
    /// Estimated chance that the depth is right within 5 %, times the correlation of the windows; never 0.
    pub confidence: &'a [f32],
}

/// Matches one picture at a time; keeps its buffers.
#[derive(Debug, Default)]
pub struct Stereo {
    features: Features,
    volume: Volume,
    paths: Paths,
    depth: Vec<f32>,
    confidence: Vec<f32>,
}

impl Stereo {
    /// Bytes held for pictures of a number of pixels.
    pub fn planned_bytes(pixels: u64) -> u64 {
        // Pictures up to the limit have cells of one pixel.
        let cells = (pixels / 4).max(pixels.min(u64::from(LARGE).pow(2)));
        // The longer side of a picture four times as long as it is wide.
        let across = 2 * cells.isqrt();
        Features::planned_bytes(cells)
            + Volume::planned_bytes(cells, across)
            + Paths::planned_bytes(cells, across)
            + 8 * cells
    }

    /// Depths of `reference` between the nearest and the farthest depth of `range`, by at most [`SOURCES`] others.
    pub fn depths(&mut self, reference: &RgbImage, sources: &[Source<'_>], range: [f32; 2]) -> Depths<'_> {
        let sources = &sources[..sources.len().min(SOURCES)];
        let (width, height) = reference.dimensions();
        let cell = if width.max(height) > LARGE && width.min(height) >= NARROW { 2 } else { 1 };
        let inverse = Inverse::over(range);
        self.features.make(reference, sources, cell);
        let smoothness = Smoothness::of(sources.len());
        self.volume.fill(&self.features, sources, inverse, smoothness);
        self.paths.run(&self.volume, &self.features, smoothness);
        winner::choose(&self.paths, &self.volume, inverse, (&mut self.depth, &mut self.confidence));
        Depths { width: self.features.width, cell, depth: &self.depth, confidence: &self.confidence }
    }

    #[cfg(test)]
    fn held_bytes(&self) -> u64 {
        let own = 4 * (self.depth.capacity() + self.confidence.capacity()) as u64;
        own + self.features.held_bytes() + self.volume.held_bytes() + self.paths.held_bytes()
    }

    /// Gives the memory back.
    pub fn close(&mut self) {
        *self = Self::default();
    }
}
