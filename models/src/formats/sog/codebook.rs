//! Many numbers as indices of 256: the values that leave the least squared error, by Lloyd's iteration on the sorted numbers.

/// Values of a codebook: an index is a byte of a picture.
const VALUES: usize = 256;
/// Cells of the histogram that the first values are taken from: sixteen a value.
const CELLS: usize = 4096;
/// Rounds of Lloyd's iteration; each is 256 searches, next to nothing beside the sorting.
const ROUNDS: usize = 40;

/// 256 numbers in ascending order.
pub(super) struct Codebook {
    values: Vec<f32>,
}

impl Codebook {
    /// The codebook of `numbers`, which are finite; their order does not matter.
    pub(super) fn of(numbers: impl Iterator<Item = f32>) -> Self {
        let mut sorted: Vec<f32> = numbers.collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let (Some(&low), Some(&high)) = (sorted.first(), sorted.last()) else {
            return Self { values: vec![0.0; VALUES] };
        };
        // sums[i]: the sum of the first i numbers.
        let mut sums = Vec::with_capacity(sorted.len() + 1);
        sums.push(0.0f64);
        let mut sum = 0.0;
        sums.extend(sorted.iter().map(|v| {
            sum += f64::from(*v);
            sum
        }));
        let mut values = first_values(&sorted, low, high);
        for _ in 0..ROUNDS {
            let mut from = 0;
            for k in 0..VALUES {
                let below = |v: &f32| k + 1 == VALUES || *v < middle(values[k], values[k + 1]);
                let to = from + sorted[from..].partition_point(below);
                if to > from {
                    // The borders of the cells after this one move only up to their old values.
                    values[k] = ((sums[to] - sums[from]) / (to - from) as f64) as f32;
                }
                from = to;
            }
        }
        values.sort_unstable_by(f32::total_cmp);
        Self { values }
    }

    /// The values, as the file's JSON has them.
    pub(super) fn values(&self) -> &[f32] {
        &self.values
    }

    /// Index of the nearest value.
    pub(super) fn index(&self, v: f32) -> u8 {
        let above = self.values.partition_point(|c| *c < v).min(VALUES - 1);
        let below = above.saturating_sub(1);
        if v - self.values[below] < self.values[above] - v { below as u8 } else { above as u8 }
    }
}

fn middle(a: f32, b: f32) -> f32 {
    0.5 * (a + b)
}

/// Values as dense as the cube root of the numbers' density, which is the least error for many values (Panter and Dite 1951).
fn first_values(sorted: &[f32], low: f32, high: f32) -> Vec<f32> {
    let width = (f64::from(high) - f64::from(low)) / CELLS as f64;
    if width <= 0.0 {
        return vec![low; VALUES];
    }
    let mut mass = vec![0.0f64; CELLS];
    for v in sorted {
        let cell = ((f64::from(*v) - f64::from(low)) / width) as usize;
        mass[cell.min(CELLS - 1)] += 1.0;
    }
    mass.iter_mut().for_each(|m| *m = m.cbrt());
    let step = mass.iter().sum::<f64>() / VALUES as f64;
    let (mut values, mut passed) = (Vec::with_capacity(VALUES), 0.0);
    for (cell, m) in mass.iter().enumerate() {
        while values.len() < VALUES && (values.len() as f64 + 0.5) * step <= passed + m {
            let within = ((values.len() as f64 + 0.5) * step - passed) / m;
            values.push((f64::from(low) + (cell as f64 + within) * width) as f32);
        }
        passed += m;
    }
    values.resize(VALUES, high);
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_numbers_than_values_are_kept_within_three_thousandths_of_their_range() {
        let numbers: Vec<f32> = (0..200).map(|i| (i as f32 * 0.37).sin() * 5.0).collect();
        let book = Codebook::of(numbers.iter().copied());
        for v in numbers {
            let got = book.values()[usize::from(book.index(v))];
            assert!((got - v).abs() < 0.03, "{v} became {got}");
        }
        let same = Codebook::of([2.5f32; 9].into_iter());
        assert_eq!(same.values()[usize::from(same.index(2.5))], 2.5);
    }

    #[test]
    fn the_error_is_less_than_that_of_even_steps() {
        // Many numbers around zero, few far away, as colours' directional parts have them.
        let numbers: Vec<f32> = (1..20_000).map(|i| (i as f32 / 10_000.0 - 1.0).powi(5) * 8.0).collect();
        let book = Codebook::of(numbers.iter().copied());
        let error = |v: &f32| f64::from(book.values()[usize::from(book.index(*v))] - v).powi(2);
        let ours = numbers.iter().map(error).sum::<f64>() / numbers.len() as f64;
        // What a step of range / 255 leaves on average.
        let even = (16.0f64 / 255.0).powi(2) / 12.0;
        // Panter and Dite: (∫p^⅓)³ / range² = 0.507 for this density.
        assert!(ours < 0.55 * even, "{ours} against {even}");
    }

    #[test]
    fn the_nearest_value_is_taken() {
        let book = Codebook::of((0..1000).map(|i| (i as f32 * 0.7).cos()));
        for i in 0..500 {
            let v = i as f32 / 200.0 - 1.2;
            let got = (book.values()[usize::from(book.index(v))] - v).abs();
            let best = book.values().iter().fold(f32::INFINITY, |m, c| m.min((c - v).abs()));
            assert_eq!(got, best, "{v}");
        }
    }
}
