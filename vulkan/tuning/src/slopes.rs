//! How a stage's time grows: a straight line through time against the one quantity the stage loops over, and how much of it each
//! quantity takes where only whole times are known.

use serde::Serialize;
use vulkan::stages::Stage;
use vulkan::stages::work::Load;

/// What a stage loops over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Driver {
    /// Gaussians on the device.
    Gaussians,
    /// Gaussians in view.
    Visible,
    /// Pixels.
    Pixels,
    /// Gaussian–tile instances.
    Instances,
    /// Gaussian–pixel evaluations.
    Evaluations,
}

/// Every driver, in the order in which they are reported.
pub const DRIVERS: [Driver; 5] =
    [Driver::Gaussians, Driver::Visible, Driver::Pixels, Driver::Instances, Driver::Evaluations];

impl Driver {
    /// What `stage` loops over, and why.
    pub fn of(stage: Stage) -> (Self, &'static str) {
        match stage {
            Stage::Target => (Self::Pixels, "one lane per pixel unpacks the picture"),
            Stage::Project => (Self::Gaussians, "every Gaussian is projected before it is known to be out of view"),
            Stage::Sort => (Self::Visible, "four radix passes over the visible depths, a histogram per lane besides"),
            Stage::Shade => (Self::Visible, "SH of the visible, and lazy Adam's missed steps"),
            Stage::Count => (Self::Instances, "walks each visible Gaussian's tiles"),
            Stage::Emit => (Self::Instances, "walks them again and writes each once"),
            Stage::Rasterise => (Self::Evaluations, "an exponential for every pixel of every instance in front"),
            Stage::Loss => (Self::Pixels, "SSIM's two 11-tap passes forward and backward, whatever the scene"),
            Stage::RasteriseBackward => (Self::Evaluations, "the same evaluations again with nine gradients each"),
            Stage::Reduce => (Self::Instances, "adds up one gradient slot per instance"),
            Stage::Optimise => (Self::Visible, "projection's gradient and Adam on 59 parameters of each visible one"),
        }
    }

    /// How many of them a step had.
    pub fn amount(self, load: &Load) -> u64 {
        match self {
            Self::Gaussians => load.gaussians,
            Self::Visible => load.visible,
            Self::Pixels => load.pixels,
            Self::Instances => load.instances,
            Self::Evaluations => load.evaluations,
        }
    }

    /// The singular, for sentences.
    pub fn name(self) -> &'static str {
        match self {
            Self::Gaussians => "Gaussian",
            Self::Visible => "visible Gaussian",
            Self::Pixels => "pixel",
            Self::Instances => "instance",
            Self::Evaluations => "pixel evaluation",
        }
    }
}

/// `y = fixed + per_unit·x`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Line {
    /// y at x = 0.
    pub fixed: f64,
    /// Growth of y per unit of x.
    pub per_unit: f64,
    /// Share of y's variance that the line explains; none when all x or all y are the same.
    pub r_squared: Option<f64>,
}

/// The least-squares line; `None` without points. Points that share one x give a line through the origin.
pub fn fit(points: &[(f64, f64)]) -> Option<Line> {
    let n = points.len() as f64;
    if points.is_empty() {
        return None;
    }
    let mean = |f: fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (x, y) in points {
        xx += (x - mx) * (x - mx);
        xy += (x - mx) * (y - my);
        yy += (y - my) * (y - my);
    }
    if xx <= 1e-12 * mx * mx * n {
        let per_unit = if mx > 0.0 { my / mx } else { 0.0 };
        return Some(Line { fixed: 0.0, per_unit, r_squared: None });
    }
    let per_unit = xy / xx;
    let r_squared = (yy > 0.0).then(|| xy * xy / (xx * yy));
    Some(Line { fixed: my - per_unit * mx, per_unit, r_squared })
}

/// Sweeps of [`nonnegative`]: columns that grow together converge slowly, and what they say together does not change any more.
const SWEEPS: usize = 2000;

/// What each amount costs, never less than nothing, so that amounts times costs come nearest to every row's time: the squares of what is
/// missed as a share of the time, so that small times count as much as large ones. Rows without a time say nothing.
pub fn nonnegative<const N: usize>(rows: &[([f64; N], f64)]) -> [f64; N] {
    let rows: Vec<[f64; N]> = rows.iter().filter(|r| r.1 > 0.0).map(|(amounts, y)| amounts.map(|x| x / y)).collect();
    let squares: [f64; N] = std::array::from_fn(|k| rows.iter().map(|r| r[k] * r[k]).sum());
    let mut costs = [0.0; N];
    for _ in 0..SWEEPS {
        for k in 0..N {
            let missed = |row: &[f64; N]| 1.0 - (0..N).filter(|o| *o != k).map(|o| costs[o] * row[o]).sum::<f64>();
            let along: f64 = rows.iter().map(|row| row[k] * missed(row)).sum();
            costs[k] = if squares[k] > 0.0 { (along / squares[k]).max(0.0) } else { 0.0 };
        }
    }
    costs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_are_found_from_whole_times_and_none_is_below_zero() {
        let rows = [[1.0, 10.0, 3.0], [1.0, 2.0, 50.0], [1.0, 30.0, 7.0], [1.0, 1.0, 1.0]];
        let timed = rows.map(|r| (r, 0.5 * r[0] + 2.0 * r[1] + 0.1 * r[2]));
        let found = nonnegative(&timed);
        assert!(found.iter().zip([0.5, 2.0, 0.1]).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
        // A time that falls as the amount grows costs nothing more, and not less than nothing.
        let falling = nonnegative(&[([1.0, 1.0], 10.0), ([1.0, 2.0], 9.0)]);
        assert!(falling[1] == 0.0 && (9.0..10.0).contains(&falling[0]), "{falling:?}");
        assert_eq!(nonnegative::<2>(&[]), [0.0; 2]);
        assert_eq!(nonnegative(&[([1.0, 0.0], 0.0), ([1.0, 0.0], 4.0)]), [4.0, 0.0]);
    }

    #[test]
    fn points_on_a_line_give_that_line() {
        let line = fit(&[(1.0, 5.0), (2.0, 7.0), (4.0, 11.0)]).unwrap();
        assert!((line.fixed - 3.0).abs() < 1e-12 && (line.per_unit - 2.0).abs() < 1e-12);
        assert!((line.r_squared.unwrap() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn one_x_is_a_line_through_the_origin_and_nothing_is_none() {
        assert_eq!(fit(&[]), None);
        let line = fit(&[(4.0, 7.0), (4.0, 9.0)]).unwrap();
        assert_eq!((line.fixed, line.per_unit, line.r_squared), (0.0, 2.0, None));
    }
}
