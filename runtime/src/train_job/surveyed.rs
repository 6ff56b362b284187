//! A card's surveyed points in the pictures of its finished model: how far off it puts them. Figures in `run.json`, a row for each point
//! in `accuracy.csv`, and `accuracy.html` with what the standard says of them and with pictures of the marks.

use std::path::Path;

use disk::Disk;
use engine::Reconstruction;
use engine::evaluate::surveyed::{self, PointOff};
use measure::accuracy::{Accuracy, Axes, Checked};
use models::camera::View;
use models::refine::ControlPoint;
use pages::report::{ReportData, Table};
use survey::card::control::SurveyedPoint;
use survey::dataset::{CardNotes, Dataset, scaled};

use crate::error::JobError;

mod crops;

use crops::Crops;

const POINTS: &str = "accuracy.csv";
const PAGE: &str = "accuracy.html";

/// What surveyed points are for.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Use {
    /// They were given to hold the poses.
    Control,
    /// They were kept back.
    Check,
}

impl Use {
    fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::Control => ("ground control", "ground_control"),
            Self::Check => ("check points", "check_points"),
        }
    }
}

/// A point, and how far off the model shows it.
struct Row<'a> {
    of: Use,
    point: &'a SurveyedPoint,
    found: PointOff,
}

/// What is compared with a card's surveyed points.
pub(super) struct Inputs<'a> {
    pub set: &'a Dataset,
    pub notes: &'a CardNotes,
    /// The poses are those that the pictures agreed on, not those that they state.
    pub is_refined: bool,
    /// Size of the pictures, as a share.
    pub scale: f64,
}

/// Takes away what an earlier training of the folder wrote: its model is about to be another.
///
/// # Errors
/// The system's.
pub(super) fn forget(out: &Path) -> Result<(), JobError> {
    for earlier in [out.join(POINTS), out.join(PAGE)].iter().filter(|path| path.is_file()) {
        Disk::default().remove(earlier).map_err(JobError::io(earlier))?;
    }
    Ok(())
}

/// How far the model's renderings put a card's surveyed points off, those that held its poses and those that did not.
///
/// # Errors
/// The renderer's; the files cannot be written.
pub(super) fn measure(
    engine: &mut Reconstruction,
    &Inputs { set, notes, is_refined, scale }: &Inputs,
    out: &Path,
    cancelled: &dyn Fn() -> bool,
) -> Result<(), JobError> {
    let clock = std::time::Instant::now();
    let both = [(Use::Check, &notes.check), (Use::Control, &notes.control)];
    let given: usize = both.iter().map(|(_, points)| points.len()).sum();
    let Some(origin) = set.origin else {
        if given > 0 {
            tracing::warn!(
                "surveyed points: nothing says where on Earth the scene is, so that none of {given} can be compared; give positions or more ground control"
            );
        }
        return Ok(());
    };
    let view_of = |name: &str| {
        let view = set.frames.iter().find(|f| f.name == name)?.view;
        Some(View { intrinsics: scaled(&view.intrinsics, scale).ok()?, ..view })
    };
    let (mut rows, mut crops) = (Vec::new(), Crops::default());
    for (of, points) in both.into_iter().filter(|(_, points)| !points.is_empty()) {
        let (what, key) = of.words();
        let marked: Vec<ControlPoint> = surveyed::marked(set, points, origin, scale);
        let scores = surveyed::compare(engine.trainer(), &marked, &view_of, cancelled, &mut |mark| {
            crops.take(what, &points[mark.point].name, mark);
        })?;
        let Some(scores) = scores else {
            tracing::warn!("{what}: not compared: the job was cancelled");
            return Ok(());
        };
        scores.announce(what);
        rows.extend(scores.each.iter().map(|found| Row { of, point: &points[found.point], found: found.clone() }));
        engine.report.more.insert(key.to_owned(), serde_json::to_value(scores)?);
    }
    if rows.is_empty() {
        return Ok(());
    }
    let accuracy = Accuracy::of(&checked(&rows));
    if let Some(accuracy) = &accuracy {
        accuracy.statements().iter().for_each(|s| tracing::info!("check points: {s}"));
        engine.report.more.insert("accuracy".to_owned(), serde_json::to_value(accuracy)?);
    }
    let doubts = doubts(&rows, accuracy.as_ref(), is_refined);
    doubts.iter().for_each(|d| tracing::warn!("surveyed points: {d}"));
    let (to, text) = (out.join(POINTS), table(&rows));
    Disk::default().replace(&to, |file| file.write_all(text.as_bytes())).map_err(|e| JobError::io(&to)(e.into()))?;
    let mut page = page(&rows, accuracy.as_ref(), crops.points());
    (page.comparisons, page.warnings) = (crops.beside_photographs(set, scale), doubts);
    page.write(&out.join(PAGE))?;
    engine.report.stage("surveyed", clock);
    Ok(())
}

/// The check points among them that the model shows, as the standard takes them.
fn checked(rows: &[Row]) -> Vec<Checked> {
    let of = |r: &Row| {
        Some(Checked {
            off_m: r.found.off_m?,
            up_m: r.found.up_m,
            sigma_m: r.point.sigma_m,
            is_sigma_stated: is_stated(r.point),
            is_vegetated: r.point.is_vegetated(),
        })
    };
    rows.iter().filter(|r| r.of == Use::Check).filter_map(of).collect()
}

/// Whether the survey says what is needed of its standard deviations.
fn is_stated(point: &SurveyedPoint) -> bool {
    point.is_sigma_stated[0] && (point.is_sigma_stated[1] || !point.has_height())
}

/// What a reader should know before trusting the figures.
fn doubts(rows: &[Row], accuracy: Option<&Accuracy>, is_refined: bool) -> Vec<String> {
    let mut out = accuracy.map(Accuracy::doubts).unwrap_or_default();
    let unseen: Vec<&str> = rows.iter().filter(|r| r.found.marks == 0).map(|r| r.point.name.as_str()).collect();
    if let Some(first) = unseen.first() {
        let more = if unseen.len() > 1 { ", …" } else { "" };
        out.push(format!(
            "Of {} points {} are shown at none of their marks ({first}{more}): the model or the pictures end before.",
            rows.len(),
            unseen.len()
        ));
    }
    let has = |of: Use| rows.iter().any(|r| r.of == of);
    let of_control = match (is_refined, has(Use::Check), has(Use::Control)) {
        (false, _, true) => Some("The poses are those that the pictures state: no surveyed point held them."),
        (true, false, true) => Some(
            "These points were given to hold the poses: their errors say how well they fit, not how true the map is.",
        ),
        _ => None,
    };
    out.extend(of_control.map(str::to_owned));
    out
}

/// One line a point; metres.
fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "name,use,marks,off_east_m,off_north_m,off_up_m,off_horizontal_m,survey_sigma_horizontal_m,survey_sigma_up_m,sigma_stated,vegetated\n",
    );
    let number = |value: Option<f64>| value.map_or_else(String::new, |v| format!("{v:.4}"));
    let word = |is: bool| if is { "yes" } else { "no" }.to_owned();
    for r in rows {
        let [east, north] = [0, 1].map(|axis| Some(r.found.off_m?[axis]));
        let cells = [
            disk::table::field(&r.point.name).into_owned(),
            r.of.words().0.to_owned(),
            r.found.marks.to_string(),
            number(east),
            number(north),
            number(r.found.up_m),
            number(r.found.off_m.map(|[east, north]| east.hypot(north))),
            number(Some(r.point.sigma_m[0])),
            number(Some(r.point.sigma_m[1]).filter(|_| r.point.has_height())),
            word(is_stated(r.point)),
            word(r.point.is_vegetated()),
        ];
        text.push_str(&cells.join(","));
        text.push('\n');
    }
    text
}

fn metres(value: f64) -> String {
    format!("{value:.3} m")
}

fn or_dash(value: Option<f64>) -> String {
    value.map_or_else(|| "–".to_owned(), metres)
}

fn texts(of: &[&str]) -> Vec<String> {
    of.iter().map(|s| (*s).to_owned()).collect()
}

/// All of it but what to doubt and the pictures, which show the marks of some points.
fn page(rows: &[Row], accuracy: Option<&Accuracy>, pictured: usize) -> ReportData {
    let count = |of: Use, what: &str| {
        let n = rows.iter().filter(|r| r.of == of).count();
        format!("{n} {what}{}", if n == 1 { "" } else { "s" })
    };
    let mut data = ReportData {
        title: "Accuracy of the map".into(),
        subtitle: format!(
            "{}, {}; an error is where the map has a point minus where it was surveyed",
            count(Use::Check, "check point"),
            count(Use::Control, "ground control point")
        ),
        files: vec![("every point".to_owned(), POINTS.into())],
        ..ReportData::default()
    };
    if let Some(accuracy) = accuracy {
        data.headline = vec![
            ("RMSE in the plane".into(), metres(accuracy.horizontal_m)),
            ("RMSE in height".into(), or_dash(accuracy.vertical_m)),
            ("RMSE in space".into(), or_dash(accuracy.space_m)),
            ("check points".into(), accuracy.points.to_string()),
        ];
        data.tables.extend(of_check_points(accuracy));
    }
    let each = |r: &Row| {
        let name = match r.point.is_vegetated() {
            true => format!("{} (under vegetation)", r.point.name),
            false => r.point.name.clone(),
        };
        let [east, north] = [0, 1].map(|axis| or_dash(r.found.off_m.map(|off| off[axis])));
        let sigma = |value: Option<f64>, is_stated: bool| match value {
            Some(value) if !is_stated => format!("assumed {}", metres(value)),
            value => or_dash(value),
        };
        let sigma_up = Some(r.point.sigma_m[1]).filter(|_| r.point.has_height());
        vec![
            name,
            r.of.words().0.to_owned(),
            r.found.marks.to_string(),
            east,
            north,
            or_dash(r.found.up_m),
            sigma(Some(r.point.sigma_m[0]), r.point.is_sigma_stated[0]),
            sigma(sigma_up, r.point.is_sigma_stated[1]),
        ]
    };
    data.tables.push(Table {
        title: "Every point".into(),
        note: format!(
            "The mean error of its marks, and the survey's own standard deviation along an axis and in height. Pictures show the marks of {pictured} of {} points.",
            rows.len()
        ),
        head: texts(&["point", "use", "marks", "east", "north", "up", "sigma in the plane", "sigma up"]),
        rows: rows.iter().map(each).collect(),
    });
    data
}

/// Along each axis, and as the standard counts.
fn of_check_points(a: &Accuracy) -> [Table; 2] {
    let axes = |name: &str, v: &Axes| vec![name.to_owned(), metres(v.east), metres(v.north), or_dash(v.up)];
    let row = |name: &str, differences: Option<f64>, survey: Option<f64>, all: Option<f64>| {
        vec![name.to_owned(), or_dash(differences), or_dash(survey), or_dash(all)]
    };
    let in_plane = Some(a.rms_m.east.hypot(a.rms_m.north));
    let mut counted = vec![
        row("in the plane (RMSE_H)", in_plane, Some(a.survey_horizontal_m), Some(a.horizontal_m)),
        row("height of open ground (RMSE_V, NVA)", a.rms_m.up, a.survey_vertical_m, a.vertical_m),
    ];
    if a.vegetated_m.is_some() {
        counted.push(row("height under vegetation (RMSE_V, VVA)", None, None, a.vegetated_m));
    }
    counted.push(row("in space (RMSE_3D)", None, None, a.space_m));
    [
        Table {
            title: "Check points along each axis".into(),
            note: format!("Errors in the plane are of all {} points, heights of {} on open ground.", a.points, a.open),
            head: texts(&["", "east", "north", "up"]),
            rows: vec![axes("root mean square error", &a.rms_m), axes("mean error (bias)", &a.mean_m)],
        },
        Table {
            title: "Accuracy as the ASPRS standard counts it".into(),
            note: a.statements().join(" "),
            head: texts(&["", "of the differences", "of the survey itself", "together"]),
            rows: counted,
        },
    ]
}

#[cfg(test)]
mod tests {
    use geometry::geodesy::Geodetic;

    use super::*;

    fn point(name: &str, sigma_up: f64) -> SurveyedPoint {
        let position = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 400.0 };
        let (sigma_m, is_sigma_stated) = ([0.02, sigma_up], [true, sigma_up < 1.0]);
        SurveyedPoint { name: name.into(), position, sigma_m, is_sigma_stated, marks: Vec::new() }
    }

    fn row(of: Use, point: &SurveyedPoint, off_m: Option<[f64; 3]>) -> Row<'_> {
        let up_m = off_m.filter(|_| point.has_height()).map(|o| o[2]);
        let marks = if off_m.is_some() { 3 } else { 0 };
        let off_m = off_m.map(|o| [o[0], o[1]]);
        Row { of, point, found: PointOff { point: 0, name: point.name.clone(), marks, off_m, up_m } }
    }

    #[test]
    fn every_point_has_a_row_and_figures_only_where_there_are_any() {
        let (control, check) = (point("g,1", 0.03), point("CHK-VVA-2", 100.0));
        let rows = [
            row(Use::Check, &check, Some([0.03, 0.04, 9.0])),
            row(Use::Control, &control, Some([0.0, -0.1, 0.25])),
            row(Use::Check, &control, None),
        ];
        let text = table(&rows);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[1], "CHK-VVA-2,check points,3,0.0300,0.0400,,0.0500,0.0200,,yes,yes");
        assert_eq!(lines[2], "\"g,1\",ground control,3,0.0000,-0.1000,0.2500,0.1000,0.0200,0.0300,yes,no");
        assert_eq!(lines[3], "\"g,1\",check points,0,,,,,0.0200,0.0300,yes,no");
        assert_eq!(checked(&rows).len(), 1, "what the model does not show says nothing of it");
        assert!(doubts(&rows, None, true)[0].contains("Of 3 points 1 are"));
    }

    #[test]
    fn the_page_says_every_figure_with_its_unit_and_no_class_of_few_points() {
        let points: Vec<SurveyedPoint> = (0..5).map(|i| point(&format!("CHK-{i}"), 0.03)).collect();
        let control = point("g1", 0.03);
        let mut rows: Vec<Row> = points.iter().map(|p| row(Use::Check, p, Some([0.03, -0.02, 0.4]))).collect();
        rows.push(row(Use::Control, &control, Some([9.0, 9.0, 9.0])));
        let accuracy = Accuracy::of(&checked(&rows)).expect("points");
        assert!(accuracy.rms_m.east < 0.031, "ground control does not count");
        let warnings = doubts(&rows, Some(&accuracy), true);
        assert!(warnings.iter().any(|w| w.contains("0.400 m too high")), "{warnings:?}");
        let page = page(&rows, Some(&accuracy), 4);
        assert!(page.tables[2].note.contains("the marks of 4 of 6 points"));
        assert!(page.tables[1].note.contains("asks for 30") && !page.tables[1].note.contains("Tested to meet"));
        assert_eq!(page.tables[2].rows.len(), 6);
        let figures = page.tables.iter().flat_map(|t| &t.rows).flat_map(|r| r.iter().skip(1));
        assert!(figures.filter(|f| f.contains('.')).all(|f| f.ends_with(" m")));
        assert!(page.to_html().expect("a page").contains("CHK-4"));
        let alone = [true, false].map(|is_refined| doubts(&rows[5..], None, is_refined).join(" "));
        assert!(alone[0].contains("not how true the map is") && !alone[1].contains("given to hold"), "{alone:?}");
        let all = [warnings, alone.to_vec()].concat();
        let mut sentences = all.iter().flat_map(|s| s.split(". "));
        assert!(sentences.all(|s| s.split_whitespace().count() <= 25), "{all:?}");
    }
}
