//! What pictures are compared by: luminance, normalised by its local mean and deviation.

use image::RgbImage;

use super::Source;

/// Half the side of the window of the normalisation, cells.
const HALF: usize = 3;
/// Variance of a sensor's noise, at luminances of 0…2.
const NOISE: f32 = 4e-4;
/// What a deviation of 1 is worth, and the most that is kept.
const SCALE: f32 = 32.0;
const MOST: f32 = 127.0;
/// What the product of two features is worth.
pub const PRODUCT: f32 = SCALE * SCALE;

/// Features of a picture twice as fine as cells.
#[derive(Debug, Default)]
pub struct Finer {
    pub width: usize,
    pub height: usize,
    /// Side of a value, pixels.
    pub pixels: f32,
    /// Row by row; the last value, beyond the picture, is 0.
    pub values: Vec<i16>,
}

/// Features of a reference in its cells, and of its sources.
#[derive(Debug, Default)]
pub struct Features {
    pub width: usize,
    pub height: usize,
    /// Side of a cell, pixels.
    pub cell: usize,
    /// Luminance of the reference, 0…2.
    pub luminance: Vec<f32>,
    pub reference: Vec<i16>,
    pub sources: Vec<Finer>,
    cells: Vec<f32>,
    squares: Vec<f32>,
    rows: Vec<f32>,
    means: Vec<f32>,
}

impl Features {
    pub fn planned_bytes(cells: u64) -> u64 {
        cells * (4 + 2 + 4 * 4) + super::SOURCES as u64 * (cells * 8 + 64)
    }

    #[cfg(test)]
    pub fn held_bytes(&self) -> u64 {
        let floats = [&self.luminance, &self.cells, &self.squares, &self.rows, &self.means].map(Vec::capacity);
        let shorts = self.reference.capacity() + self.sources.iter().map(|s| s.values.capacity()).sum::<usize>();
        (4 * floats.iter().sum::<usize>() + 2 * shorts) as u64
    }

    /// Of a picture and its sources, in cells of `cell` pixels.
    pub fn make(&mut self, reference: &RgbImage, sources: &[Source<'_>], cell: usize) {
        let shrunk = |image: &RgbImage, out: &mut Vec<f32>| shrunk(image, cell, out);
        self.cell = cell;
        (self.width, self.height) = shrunk(reference, &mut self.cells);
        self.luminance.clear();
        self.luminance.extend_from_slice(&self.cells);
        self.normalise((self.width, self.height));
        self.reference.clear();
        self.reference.extend(self.cells.iter().map(|v| quantised(*v)));
        self.sources.resize_with(sources.len(), Finer::default);
        for (s, source) in sources.iter().enumerate() {
            let size = shrunk(source.image, &mut self.cells);
            self.normalise(size);
            let finer = &mut self.sources[s];
            (finer.width, finer.height, finer.pixels) = (2 * size.0, 2 * size.1, 0.5 * cell as f32);
            doubled(size, &self.cells, &mut finer.values);
        }
    }

    /// Takes the local mean from the cells and divides them by the local deviation.
    fn normalise(&mut self, size: (usize, usize)) {
        boxed(size, &self.cells, &mut self.rows, &mut self.means);
        self.cells.iter_mut().zip(&self.means).for_each(|(v, mean)| *v -= mean);
        self.squares.clear();
        self.squares.extend(self.cells.iter().map(|v| v * v));
        boxed(size, &self.squares, &mut self.rows, &mut self.means);
        self.cells.iter_mut().zip(&self.means).for_each(|(v, variance)| *v /= (variance + NOISE).sqrt());
    }
}

fn quantised(v: f32) -> i16 {
    (v * SCALE).round().clamp(-MOST, MOST) as i16
}

/// Luminance of a picture in cells, means of their pixels, and how many there are across and down.
fn shrunk(image: &RgbImage, cell: usize, out: &mut Vec<f32>) -> (usize, usize) {
    let (w, h) = (image.width() as usize / cell, image.height() as usize / cell);
    let pixels = image.as_raw().as_chunks::<3>().0;
    let share = 1.0 / (127.5 * (cell * cell) as f32);
    out.clear();
    out.reserve_exact(w * h);
    for y in 0..h {
        for x in 0..w {
            let of_row = |row: usize| &pixels[(cell * y + row) * image.width() as usize + cell * x..][..cell];
            let luminance = |[r, g, b]: &[u8; 3]| 0.299 * f32::from(*r) + 0.587 * f32::from(*g) + 0.114 * f32::from(*b);
            out.push(share * (0..cell).flat_map(of_row).map(luminance).sum::<f32>());
        }
    }
    (w, h)
}

/// Means over square windows; beyond the rim the picture is continued by its last cells.
fn boxed((w, h): (usize, usize), cells: &[f32], rows: &mut Vec<f32>, out: &mut Vec<f32>) {
    let share = 1.0 / ((2 * HALF + 1) * (2 * HALF + 1)) as f32;
    rows.clear();
    rows.resize(w * h, 0.0);
    for y in 0..h {
        let (row, sums) = (&cells[y * w..][..w], &mut rows[y * w..][..w]);
        for (x, sum) in sums.iter_mut().enumerate() {
            *sum = if x >= HALF && x + HALF < w {
                row[x - HALF..=x + HALF].iter().sum()
            } else {
                (0..=2 * HALF).map(|k| row[(x + k).saturating_sub(HALF).min(w - 1)]).sum()
            };
        }
    }
    out.clear();
    out.resize(w * h, 0.0);
    for y in 0..h {
        let sums = &mut out[y * w..][..w];
        for k in 0..=2 * HALF {
            let row = &rows[(y + k).saturating_sub(HALF).min(h - 1) * w..][..w];
            sums.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
        }
        sums.iter_mut().for_each(|sum| *sum *= share);
    }
}

/// Twice as fine, between cells linearly; the last value is the 0 beyond the picture.
fn doubled((w, h): (usize, usize), cells: &[f32], out: &mut Vec<i16>) {
    out.clear();
    out.reserve_exact(4 * w * h + 1);
    for y in 0..2 * h {
        // Centres of finer cells lie a quarter of a cell from those of the coarser ones.
        let (a, b) = if y % 2 == 0 { ((y / 2).saturating_sub(1), y / 2) } else { ((y / 2 + 1).min(h - 1), y / 2) };
        let (far, near) = (&cells[a * w..][..w], &cells[b * w..][..w]);
        let mixed = |x: usize| 0.25 * far[x] + 0.75 * near[x];
        for x in 0..w {
            let (left, middle, right) = (mixed(x.saturating_sub(1)), mixed(x), mixed((x + 1).min(w - 1)));
            out.push(quantised(0.25 * left + 0.75 * middle));
            out.push(quantised(0.25 * right + 0.75 * middle));
        }
    }
    out.push(0);
}
