//! The surface of a map: heights without the noise of single rays, and what they are worth.
//!
//! Neighbouring rays through a model end in different Gaussians, so that their heights scatter about the surface. The median of a few
//! pixels of the pictures does not, and what it still differs by from its surroundings says how far it is off: the share of that, and
//! of a pixel's noise in the rays that meet there, are fitted to simulated surveys (`bench map --survey all`).

use rayon::prelude::*;

/// Pixels of the pictures to each side of which the median is taken.
const REACH: i32 = 2;
/// Pixels of the pictures over which heights are compared, beyond the median's reach.
const LAG: f64 = 4.0;
/// Pixels of a map that is finer than the pictures reach no farther than so many of its own to one of theirs.
const FINEST: f64 = 2.0;
/// Standard deviation of a height to the root mean square of how far those around it are off the mean of their opposite neighbours.
const ROUGHNESS: f64 = 1.6;
/// Standard deviation, pixels of the pictures, of the rays that meet in a place.
const RAY_PX: f64 = 0.03;
/// Variance of h(x) − (h(x−l) + h(x+l))/2 for one of independent heights.
const SECOND: f32 = 1.5;

/// How a map's heights are taken from single rays.
#[derive(Clone, Debug)]
pub struct Surface {
    /// Where the median looks along each axis, pixels of the map.
    steps: [i32; 2 * REACH as usize + 1],
    lag: usize,
}

/// What is used from block to block.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    squares: Vec<[f32; 2]>,
    rows: Vec<[f32; 2]>,
}

impl Surface {
    /// Of a map whose pixels have a side of `gsd`, from pictures whose pixels cover `pictures` on the ground, metres.
    pub fn of(pictures: Option<f64>, gsd: f64) -> Self {
        let ratio = pictures.map_or(1.0, |pictures| (pictures / gsd).min(FINEST));
        let steps = std::array::from_fn(|k| (f64::from(k as i32 - REACH) * ratio).round() as i32);
        Self { steps, lag: (LAG * ratio).round().max(1.0) as usize }
    }

    /// Pixels of the map along the side of the square that a height is the median of.
    pub fn side(&self) -> usize {
        let [first, .., last] = self.steps;
        (last - first + 1) as usize
    }

    /// The median around each pixel of a square of `side` pixels, row by row. NaN is no height, and stays so.
    pub fn smooth(&self, side: usize, rays: &[f32], into: &mut Vec<f32>) {
        into.clear();
        into.resize(rays.len(), f32::NAN);
        into.par_chunks_mut(side).enumerate().for_each(|(y, row)| {
            let mut around = [0.0; (2 * REACH as usize + 1).pow(2)];
            for (x, height) in row.iter_mut().enumerate().filter(|(x, _)| rays[y * side + x].is_finite()) {
                let mut n = 0;
                for z in self.around(side, [x, y]).map(|i| rays[i]).filter(|z| z.is_finite()) {
                    around[n] = z;
                    n += 1;
                }
                *height = *around[..n].select_nth_unstable_by(n / 2, f32::total_cmp).1;
            }
        });
    }

    /// The root mean square, around each pixel, of how far heights are off the mean of their opposite neighbours, divided by what that
    /// is for independent ones. NaN where nothing is to compare with.
    pub fn roughness(&self, side: usize, heights: &[f32], scratch: &mut Scratch, into: &mut Vec<f32>) {
        let Scratch { squares, rows } = scratch;
        squares.clear();
        squares.resize(heights.len(), [0.0; 2]);
        squares.par_chunks_mut(side).enumerate().for_each(|(y, row)| {
            for (x, sum) in row.iter_mut().enumerate() {
                let at = y * side + x;
                let mut add = |is_inside: bool, step: usize| {
                    if is_inside {
                        let off = heights[at] - 0.5 * (heights[at - step] + heights[at + step]);
                        if off.is_finite() {
                            *sum = [sum[0] + off * off / SECOND, sum[1] + 1.0];
                        }
                    }
                };
                let is_inside = |k: usize| k >= self.lag && k + self.lag < side;
                add(is_inside(x), self.lag);
                add(is_inside(y), self.lag * side);
            }
        });
        let added = |sum: [f32; 2], more: [f32; 2]| [sum[0] + more[0], sum[1] + more[1]];
        rows.clear();
        rows.extend((0..heights.len()).map(|i| {
            let (x, y) = (i % side, i / side);
            self.along(side, x).map(|x| squares[y * side + x]).fold([0.0; 2], added)
        }));
        into.clear();
        into.extend((0..heights.len()).map(|i| {
            let (x, y) = (i % side, i / side);
            let [sum, n] = self.along(side, y).map(|y| rows[y * side + x]).fold([0.0; 2], added);
            (sum / n).sqrt()
        }));
    }

    /// Standard deviation of a height, metres, of its surroundings' roughness and of what a pixel's noise in the rays makes of it.
    pub fn height_sigma(roughness: f32, per_pixel: f64) -> f64 {
        (ROUGHNESS * f64::from(roughness)).hypot(RAY_PX * per_pixel)
    }

    /// Standard deviation of a place along an axis of the plane, metres. What its height is off by moves it along the mean slope of
    /// the rays that met there.
    pub fn plane_sigma(height_sigma: f64, slope: f64, per_pixel: f64) -> f64 {
        (slope * height_sigma).hypot(RAY_PX * per_pixel)
    }

    fn along(&self, side: usize, at: usize) -> impl Iterator<Item = usize> {
        self.steps
            .iter()
            .map(move |step| at as i32 + step)
            .filter(move |k| (0..side as i32).contains(k))
            .map(|k| k as usize)
    }

    fn around(&self, side: usize, [x, y]: [usize; 2]) -> impl Iterator<Item = usize> {
        self.along(side, y).flat_map(move |y| self.along(side, x).map(move |x| y * side + x))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;

    const SIDE: usize = 60;

    /// Independent errors of a standard deviation of one: twelve uniform numbers.
    fn noise(seed: u64) -> Vec<f32> {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let mut uniform = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        (0..SIDE * SIDE).map(|_| (0..12).map(|_| uniform()).sum::<f32>() - 6.0).collect()
    }

    #[test]
    fn the_median_takes_noise_and_what_floats_and_leaves_a_wall_where_it_is() {
        let surface = Surface::of(Some(0.1), 0.1);
        let wall = |x: usize| if x < 30 { 0.0 } else { 6.0 };
        let mut rays: Vec<f32> = noise(3).iter().enumerate().map(|(i, n)| wall(i % SIDE) + 0.05 * n).collect();
        rays[20 * SIDE + 10] = 9.0;
        rays[40 * SIDE + 40] = f32::NAN;
        let mut heights = Vec::new();
        surface.smooth(SIDE, &rays, &mut heights);
        assert!(heights[40 * SIDE + 40].is_nan(), "no height is made up");
        let off = |i: usize| (heights[i] - wall(i % SIDE)).abs();
        assert!((0..rays.len()).filter(|i| i % SIDE != 40 || i / SIDE != 40).all(|i| off(i) < 0.12));
        let square = |i: usize| f64::from(off(i)).powi(2);
        let inside = (0..rays.len()).filter(|i| (5..25).contains(&(i % SIDE)) && (5..55).contains(&(i / SIDE)));
        let rms = (inside.clone().map(square).sum::<f64>() / inside.count() as f64).sqrt();
        assert!(rms < 0.05 / 3.0, "{rms}");
    }

    #[test]
    fn roughness_is_that_of_independent_heights_whatever_the_slope() {
        let surface = Surface::of(None, 1.0);
        for slope in [0.0, 0.7] {
            let heights: Vec<f32> =
                noise(7).iter().enumerate().map(|(i, n)| slope * (i % SIDE) as f32 + 0.2 * n).collect();
            let mut rough = Vec::new();
            surface.roughness(SIDE, &heights, &mut Scratch::default(), &mut rough);
            // At the corners nothing has neighbours on both sides.
            let known: Vec<f32> = rough.into_iter().filter(|r| r.is_finite()).collect();
            assert!(known.len() > SIDE * SIDE * 9 / 10);
            let mean = known.iter().sum::<f32>() / known.len() as f32;
            assert!((mean / 0.2 - 1.0).abs() < 0.1, "{mean}");
        }
        let mut alone = vec![f32::NAN; SIDE * SIDE];
        alone[30 * SIDE + 30] = 1.0;
        let mut rough = Vec::new();
        surface.roughness(SIDE, &alone, &mut Scratch::default(), &mut rough);
        assert!(rough[30 * SIDE + 30].is_nan(), "nothing vouches for a pixel alone");
    }

    #[test]
    fn a_coarse_map_takes_each_pixel_as_it_is_and_a_fine_one_reaches_as_far_on_the_ground() {
        assert_eq!(Surface::of(Some(0.1), 1.0).steps, [0; 5]);
        assert_eq!(Surface::of(Some(0.2), 0.1).steps, [-4, -2, 0, 2, 4]);
        assert_eq!(Surface::of(Some(0.2), 0.01).steps, [-4, -2, 0, 2, 4]);
        assert_eq!((Surface::of(Some(0.1), 1.0).lag, Surface::of(Some(0.2), 0.1).lag), (1, 8));
    }
}
