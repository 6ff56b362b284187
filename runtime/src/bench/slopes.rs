//! How a stage's time grows: a straight line through time against the one quantity the stage loops over.

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

#[cfg(test)]
mod tests {
    use super::*;

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
