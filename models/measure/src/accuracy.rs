//! How true a map is by its check points, in the terms of the ASPRS Positional Accuracy Standards for Digital Geospatial Data, edition 2
//! (2023, second version 2024): root mean squares in the plane, in height and in space with the survey's own error in them, the mean
//! errors apart, heights under vegetation apart from those of open ground.

use serde::Serialize;

/// Check points that the standard asks for before accuracy may be stated as tested.
pub const LEAST: usize = 30;
/// The standard has the cause of a mean error looked for that is beyond this share of the target RMSE. Without a target, the RMSE that was
/// found stands for it.
const BIASED: f64 = 0.25;
/// Points of which a mean says nothing.
const FEW: usize = 5;
/// Points whose survey is not twice as good as what they find say little of the map.
const SURVEY_SHARE: f64 = 0.5;

/// One check point.
#[derive(Clone, Debug, PartialEq)]
pub struct Checked {
    /// Where the map has it minus where it was surveyed, east and north, metres.
    pub off_m: [f64; 2],
    /// In height; none where its height was not surveyed.
    pub up_m: Option<f64>,
    /// Standard deviation of the survey along each horizontal axis and in height, metres.
    pub sigma_m: [f64; 2],
    /// Whoever surveyed it said what is needed of these; else they are what such surveys are usually worth.
    pub is_sigma_stated: bool,
    /// It lies under vegetation, which hides the ground.
    pub is_vegetated: bool,
}

/// A figure along each axis, metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Axes {
    /// East.
    pub east: f64,
    /// North.
    pub north: f64,
    /// Up, of open ground; none without heights of such points.
    pub up: Option<f64>,
}

/// What all check points say together, metres.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Accuracy {
    /// Points.
    pub points: usize,
    /// Those of them that are of a known height, on open ground.
    pub open: usize,
    /// And under vegetation.
    pub vegetated: usize,
    /// Those whose survey does not say how good it is.
    pub assumed: usize,
    /// Root mean square differences.
    pub rms_m: Axes,
    /// Mean differences.
    pub mean_m: Axes,
    /// Root mean square of the survey's own standard deviations in the plane.
    pub survey_horizontal_m: f64,
    /// In height, of open ground.
    pub survey_vertical_m: Option<f64>,
    /// RMSE in the plane, the survey's error in it.
    pub horizontal_m: f64,
    /// RMSE of the heights of open ground, the survey's error in it.
    pub vertical_m: Option<f64>,
    /// RMSE of the heights under vegetation, the survey's error in it.
    pub vegetated_m: Option<f64>,
    /// RMSE in space: in the plane of all points, in height of open ground.
    pub space_m: Option<f64>,
}

fn square(v: f64) -> f64 {
    v * v
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, n) = values.fold((0.0, 0u32), |(sum, n), v| (sum + v, n + 1));
    (n > 0).then(|| sum / f64::from(n))
}

/// Centimetres, to the millimetre.
fn centimetres(metres: f64) -> String {
    format!("{:.1} cm", metres * 100.0)
}

impl Accuracy {
    /// What these points say; `None` of none, or where one of them is no number.
    pub fn of(points: &[Checked]) -> Option<Self> {
        let is_number = |p: &Checked| p.off_m.iter().chain(&p.sigma_m).chain(&p.up_m).all(|v| v.is_finite());
        if !points.iter().all(is_number) {
            return None;
        }
        let heights = |is_vegetated: bool| {
            points.iter().filter(move |p| p.is_vegetated == is_vegetated).filter_map(|p| Some((p.up_m?, p.sigma_m[1])))
        };
        let along = |axis: usize| {
            (mean(points.iter().map(|p| square(p.off_m[axis]))), mean(points.iter().map(|p| p.off_m[axis])))
        };
        let [(Some(east), Some(mean_east)), (Some(north), Some(mean_north))] = [along(0), along(1)] else {
            return None;
        };
        // Its two horizontal axes are as good as each other.
        let survey = 2.0 * mean(points.iter().map(|p| square(p.sigma_m[0])))?;
        let with_survey = |is_vegetated| mean(heights(is_vegetated).map(|(up, sigma)| square(up) + square(sigma)));
        let (horizontal, vertical) = (east + north + survey, with_survey(false));
        let up = mean(heights(false).map(|(up, _)| square(up))).map(f64::sqrt);
        Some(Self {
            points: points.len(),
            open: heights(false).count(),
            vegetated: heights(true).count(),
            assumed: points.iter().filter(|p| !p.is_sigma_stated).count(),
            rms_m: Axes { east: east.sqrt(), north: north.sqrt(), up },
            mean_m: Axes { east: mean_east, north: mean_north, up: mean(heights(false).map(|(up, _)| up)) },
            survey_horizontal_m: survey.sqrt(),
            survey_vertical_m: mean(heights(false).map(|(_, sigma)| square(sigma))).map(f64::sqrt),
            horizontal_m: horizontal.sqrt(),
            vertical_m: vertical.map(f64::sqrt),
            vegetated_m: with_survey(true).map(f64::sqrt),
            space_m: vertical.map(|v| (horizontal + v).sqrt()),
        })
    }

    /// Whether the standard lets accuracy be stated as tested, in the plane and in height: by enough points, surveyed well enough.
    pub fn is_tested(&self) -> [bool; 2] {
        let [in_plane, in_height] = self.is_survey_poor();
        [(self.points, in_plane), (self.open, in_height)].map(|(n, poor)| n >= LEAST && self.assumed == 0 && !poor)
    }

    /// Whether the survey is not twice as good as what it finds, in the plane and in height.
    fn is_survey_poor(&self) -> [bool; 2] {
        let poor = |survey: f64, all: f64| survey > SURVEY_SHARE * all;
        let height = self.survey_vertical_m.zip(self.vertical_m);
        [poor(self.survey_horizontal_m, self.horizontal_m), height.is_some_and(|(survey, all)| poor(survey, all))]
    }

    /// What may be stated, a sentence each.
    pub fn statements(&self) -> Vec<String> {
        let [in_plane, in_height] = self.is_tested();
        let mut out = Vec::new();
        let mut state = |found: Option<f64>, [is_tested, is_first]: [bool; 2], class: &str, what: &str| {
            let Some(found) = found else { return };
            if is_tested {
                // The class is the next whole centimetre.
                let meets = (found * 100.0 - 1e-9).ceil().max(1.0);
                let of = if is_first { " of the ASPRS standard, edition 2 (2024)" } else { "" };
                out.push(format!("Tested to meet a {meets:.0} cm {class} {what} accuracy class{of}."));
            }
            out.push(format!("The {what} accuracy was found to be {class} = {}.", centimetres(found)));
        };
        state(Some(self.horizontal_m), [in_plane, true], "RMSE_H", "horizontal positional");
        state(self.vertical_m, [in_height, !in_plane], "RMSE_V", "non-vegetated vertical");
        state(self.space_m, [in_height && in_plane, false], "RMSE_3D", "three-dimensional positional");
        // The standard sets no class for heights under vegetation.
        state(self.vegetated_m, [false; 2], "RMSE_V", "vegetated vertical");
        for (n, what) in [(self.points, "check points"), (self.open, "heights of open ground")] {
            if n < LEAST {
                out.push(format!(
                    "The standard asks for {LEAST} {what}, and these are {n}: no class is stated as tested."
                ));
            }
        }
        out
    }

    /// What a reader should know before trusting the figures, a sentence each.
    pub fn doubts(&self) -> Vec<String> {
        let mut out = Vec::new();
        let (mean, rms) = (self.mean_m, self.rms_m);
        let in_plane = "another datum or reference system, or marks beside the points";
        for ([way, back], n, mean, rms, cause) in [
            (["far east", "far west"], self.points, Some(mean.east), Some(rms.east), in_plane),
            (["far north", "far south"], self.points, Some(mean.north), Some(rms.north), in_plane),
            (["high", "low"], self.open, mean.up, rms.up, "another vertical datum or the height of an antenna"),
        ] {
            let (Some(mean), Some(rms)) = (mean, rms) else { continue };
            // The mean of a few points strays by their scatter over the square root of their number; three of those is no chance.
            let chance = 3.0 * (square(rms) - square(mean)).max(0.0).sqrt() / (n.max(1) as f64).sqrt();
            if n >= FEW && mean.abs() > BIASED * rms && mean.abs() > chance {
                out.push(format!(
                    "On the whole the map lies {:.3} m too {}. Look for a cause, such as {cause}.",
                    mean.abs(),
                    if mean > 0.0 { way } else { back }
                ));
            }
        }
        let surveys = [("in the plane", Some(self.survey_horizontal_m)), ("in height", self.survey_vertical_m)];
        for ((what, survey), _) in surveys.into_iter().zip(self.is_survey_poor()).filter(|(_, poor)| *poor) {
            out.push(format!(
                "The check points are known to {:.3} m {what}. They cannot show that the map is better, and no class is stated.",
                survey.unwrap_or_default()
            ));
        }
        if self.assumed > 0 {
            out.push(format!(
                "How well {} of {} check points were surveyed is not said in full. What is usual is assumed, and no class is stated.",
                self.assumed, self.points
            ));
        }
        out
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    fn point(off: [f64; 3], sigma_m: [f64; 2], is_vegetated: bool) -> Checked {
        Checked { off_m: [off[0], off[1]], up_m: Some(off[2]), sigma_m, is_sigma_stated: true, is_vegetated }
    }

    #[test]
    fn figures_are_those_of_the_standard_worked_out_by_hand() {
        let points = [
            point([0.03, 0.0, 0.06], [0.01, 0.02], false),
            point([-0.03, 0.04, -0.02], [0.01, 0.02], false),
            point([0.0, -0.04, 0.5], [0.01, 0.02], true),
        ];
        let found = Accuracy::of(&points).unwrap();
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} {b}");
        near(found.rms_m.east, (0.0018f64 / 3.0).sqrt());
        near(found.rms_m.north, (0.0032f64 / 3.0).sqrt());
        near(found.rms_m.up.unwrap(), 0.002f64.sqrt());
        near(found.mean_m.up.unwrap(), 0.02);
        near(found.survey_horizontal_m, 0.0002f64.sqrt());
        near(found.survey_vertical_m.unwrap(), 0.02);
        near(found.horizontal_m, (0.0018f64 / 3.0 + 0.0032 / 3.0 + 0.0002).sqrt());
        near(found.vertical_m.unwrap(), (0.002f64 + 0.0004).sqrt());
        near(found.vegetated_m.unwrap(), (0.25f64 + 0.0004).sqrt());
        near(found.space_m.unwrap(), (found.horizontal_m.powi(2) + 0.0024).sqrt());
        assert_eq!((found.points, found.open, found.vegetated, found.is_tested()), (3, 2, 1, [false; 2]));
        // Of a point without a height the place alone counts.
        let flat = Checked { up_m: None, ..point([0.0; 3], [0.01, 100.0], false) };
        let found = Accuracy::of(&[points[0].clone(), flat]).unwrap();
        near(found.vertical_m.unwrap(), (0.0036f64 + 0.0004).sqrt());
        assert_eq!((found.points, found.open), (2, 1));
    }

    #[test]
    fn a_class_is_stated_only_where_the_standard_allows_it() {
        let some_known = |n: usize, vegetated: usize, is_sigma_stated: bool| {
            let all = (0..n).map(|i| {
                let side = if i % 2 == 0 { 1.0 } else { -1.0 };
                let of = point([0.02 * side, -0.01 * side, 0.03 * side], [0.005, 0.005], i < vegetated);
                Checked { is_sigma_stated, ..of }
            });
            Accuracy::of(&all.collect::<Vec<_>>()).unwrap()
        };
        let some = |n: usize, vegetated: usize| some_known(n, vegetated, true);
        let all = (0..LEAST).map(|_| point([0.02, 0.0, 0.03], [0.02, 0.005], false)).collect::<Vec<_>>();
        let poor = Accuracy::of(&all).unwrap();
        assert_eq!(poor.is_tested(), [false, true], "surveyed no better than the map in the plane");
        let assumed = some_known(LEAST + 4, 0, false).statements().join("\n");
        assert!(!assumed.contains("Tested") && assumed.contains("RMSE_H = 2.3 cm"), "{assumed}");
        let said = some(LEAST - 1, 0).statements().join("\n");
        assert!(!said.contains("Tested") && said.matches("asks for 30").count() == 2, "{said}");
        assert!(said.contains("RMSE_H = 2.3 cm") && said.contains("these are 29"), "{said}");
        // Enough in the plane, too few of them on open ground.
        let said = some(LEAST + 4, 5).statements().join("\n");
        assert!(said.contains("meet a 3 cm RMSE_H") && said.matches("Tested").count() == 1, "{said}");
        assert!(said.contains("30 heights of open ground, and these are 29"), "{said}");
        // √(0.02² + 0.01² + 2 · 0.005²) = 2.3 cm and so on; the class is the next centimetre.
        let said = some(LEAST + 4, 4).statements();
        let whole = said.join("\n");
        for class in ["meet a 3 cm RMSE_H", "meet a 4 cm RMSE_V", "meet a 4 cm RMSE_3D"] {
            assert!(whole.contains(class), "{class}: {whole}");
        }
        assert!(whole.contains("vegetated vertical accuracy was found") && !whole.contains("asks for"), "{whole}");
        assert!(said.iter().all(|s| s.split_whitespace().count() <= 25), "{said:?}");
    }

    #[test]
    fn a_bias_and_a_survey_worse_than_the_map_are_named_and_scatter_is_not() {
        let scatter = |n: usize, mean: f64, sigma_m: [f64; 2], is_sigma_stated: bool| {
            let all = (0..n).map(|i| {
                let side = if i % 2 == 0 { 1.0 } else { -1.0 };
                let of = point([0.02 * side, 0.02 * side, mean + 0.03 * side], sigma_m, false);
                Checked { is_sigma_stated, ..of }
            });
            Accuracy::of(&all.collect::<Vec<_>>()).unwrap().doubts()
        };
        assert_eq!(scatter(36, 0.0, [0.005, 0.005], true), Vec::<String>::new());
        let said = scatter(36, -0.4, [0.005, 0.005], true);
        assert!(said.len() == 1 && said[0].contains("lies 0.400 m too low.") && said[0].contains("datum"), "{said:?}");
        let said = scatter(36, 0.0, [0.05, 0.005], true);
        assert!(said.len() == 1 && said[0].contains("in the plane"), "{said:?}");
        let said = scatter(36, 0.0, [0.005, 0.005], false);
        assert!(said.len() == 1 && said[0].contains("36 of 36") && said[0].contains("no class"), "{said:?}");
        let all = [scatter(36, -0.4, [0.9, 0.9], true), scatter(36, 0.4, [0.9, 0.9], false)].concat();
        let sentences = all.iter().flat_map(|s| s.split(". "));
        assert!(sentences.clone().count() > 5 && sentences.into_iter().all(|s| s.split_whitespace().count() <= 25));
        assert_eq!(scatter(2, -0.4, [0.005, 0.005], true), Vec::<String>::new(), "the mean of two says nothing");
    }

    #[test]
    fn of_no_points_or_of_what_is_no_number_nothing_is_said() {
        assert_eq!(Accuracy::of(&[]), None);
        assert_eq!(Accuracy::of(&[point([f64::NAN, 0.0, 0.0], [0.01, 0.01], false)]), None);
        let hidden = Accuracy::of(&[point([0.0, 0.0, 0.2], [0.01, 0.01], true)]).unwrap();
        assert_eq!((hidden.vertical_m, hidden.space_m, hidden.rms_m.up, hidden.open), (None, None, None, 0));
        assert!(hidden.vegetated_m.is_some());
    }
}
