//! A comparison as tables: quality, regions, what it takes, and what each method is.

use pages::report::{Table, count};

use super::presets::Method;
use super::score::Means;
use super::{Comparison, MethodResult};
use runtime::figures::short;

const NONE: &str = "–";
const MB: f64 = 1e6;

/// The tables, in the order of reading.
pub fn tables(comparison: &Comparison) -> Vec<Table> {
    vec![quality(comparison), regions(comparison), costs(comparison), definitions(comparison)]
}

fn head(columns: &[&str]) -> Vec<String> {
    columns.iter().map(|c| (*c).to_owned()).collect()
}

fn cell(means: Option<&Means>, show: impl Fn(&Means) -> String) -> String {
    means.map_or_else(|| NONE.to_owned(), show)
}

fn quality(comparison: &Comparison) -> Table {
    let metric = comparison.methods.iter().find_map(|m| m.quality.metric.clone());
    let mut columns = head(&["method", "PSNR, dB", "colours fitted, dB", "SSIM"]);
    columns.extend(metric.clone());
    columns.extend(head(&["near seams: PSNR, dB", "colours fitted, dB", "SSIM"]));
    let row = |m: &MethodResult| {
        let figures = |means: Option<&Means>| {
            [
                cell(means, |s| format!("{:.2}", s.psnr)),
                cell(means, |s| format!("{:.2}", s.psnr_colors_fitted)),
                cell(means, |s| format!("{:.3}", s.ssim)),
            ]
        };
        let mut cells = vec![m.method.clone()];
        cells.extend(figures(m.quality.all.as_ref()));
        if metric.is_some() {
            let of = m.quality.all.as_ref().and_then(|s| s.perceptual);
            cells.push(of.map_or_else(|| NONE.to_owned(), |p| format!("{p:.3}")));
        }
        cells.extend(figures(m.quality.near_seams.as_ref()));
        cells
    };
    let views = |of: fn(&MethodResult) -> Option<&Means>| {
        comparison.methods.iter().find_map(|m| Some(of(m)?.views)).unwrap_or(0)
    };
    let length = match (comparison.steps, comparison.seconds) {
        (Some(steps), None) => format!("{} steps", count(steps.into())),
        (steps, Some(seconds)) => {
            let steps = steps.map_or(String::new(), |s| format!(" or {} steps", count(s.into())));
            format!("{} s{steps}", short(seconds))
        }
        (None, None) => "the recipe's steps".to_owned(),
    };
    Table {
        title: format!("Methods on {}", comparison.dataset),
        note: format!(
            "{} aircraft with {} pictures; {length} and at most {} Gaussians each, a model on the ground {} times that; pictures at {} of \
             their size, seed {}. {} held-out pictures, {} of them near a seam; colours fitted: gain and offset per channel.",
            comparison.regions.len(),
            comparison.regions.iter().map(|r| r.1).sum::<usize>(),
            count(comparison.max_gaussians as u64),
            comparison.regions.len(),
            comparison.scale,
            comparison.seed,
            views(|m| m.quality.all.as_ref()),
            views(|m| m.quality.near_seams.as_ref()),
        ),
        head: columns,
        rows: comparison.methods.iter().map(row).collect(),
    }
}

fn regions(comparison: &Comparison) -> Table {
    let mut columns = head(&["method"]);
    columns.extend(comparison.regions.iter().map(|(name, _, held_out)| format!("{name} ({held_out})")));
    let row = |m: &MethodResult| {
        let show = |s: &Means| format!("{:.2} / {:.2}", s.psnr, s.psnr_colors_fitted);
        let cells = m.quality.regions.iter().map(|s| cell(s.as_ref(), show));
        std::iter::once(m.method.clone()).chain(cells).collect()
    };
    Table {
        title: "By region".into(),
        note: "PSNR, and PSNR with colours fitted, dB; held-out pictures in brackets.".into(),
        head: columns,
        rows: comparison.methods.iter().map(row).collect(),
    }
}

fn costs(comparison: &Comparison) -> Table {
    let row = |m: &MethodResult| {
        let onboard = |of: f64| if m.onboard_s.is_empty() { NONE.to_owned() } else { format!("{of:.0}") };
        let mb = |bytes: u64| short(bytes as f64 / MB);
        vec![
            m.method.clone(),
            onboard(m.onboard_s.iter().sum()),
            onboard(m.onboard_s.iter().copied().fold(0.0, f64::max)),
            format!("{:.0}", m.ground_s),
            mb(m.sent_bytes),
            mb(m.delivery_bytes),
            m.pictures_sent.to_string(),
            count(m.gaussians as u64),
            count(m.steps),
        ]
    };
    Table {
        title: "What it takes".into(),
        note: "Seconds from the pictures to the models, without the structure-from-motion that points come from; bytes that leave all \
               aircraft, with exact models (those compared) and in the delivery encoding."
            .into(),
        head: head(&[
            "method",
            "aircraft, s",
            "the longest, s",
            "ground, s",
            "sent, MB",
            "in delivery encoding, MB",
            "pictures that leave",
            "Gaussians",
            "steps",
        ]),
        rows: comparison.methods.iter().map(row).collect(),
    }
}

fn definitions(comparison: &Comparison) -> Table {
    let row = |m: &Method| {
        let departs = if m.departs.is_empty() { NONE } else { m.departs };
        vec![m.name.to_owned(), m.what.to_owned(), departs.to_owned()]
    };
    let shown = comparison.methods.iter().filter_map(|m| Method::named(&m.method));
    Table {
        title: "The methods".into(),
        note: String::new(),
        head: head(&["method", "what it is", "what is not as in its source"]),
        rows: shown.map(row).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::score::Quality;
    use super::*;
    use runtime::figures::markdown;

    fn means(psnr: f64, perceptual: Option<f64>) -> Means {
        Means { views: 7, psnr, psnr_colors_fitted: psnr + 0.5, ssim: 0.75, perceptual }
    }

    fn result(method: &str, onboard_s: Vec<f64>, perceptual: Option<f64>) -> MethodResult {
        MethodResult {
            method: method.into(),
            plan: serde_json::Value::Null,
            quality: Quality {
                all: Some(means(24.0, perceptual)),
                regions: vec![Some(means(23.0, perceptual)), None],
                near_seams: None,
                metric: perceptual.map(|_| "st-lpips".into()),
            },
            onboard_s,
            ground_s: 12.4,
            sent_bytes: 2_340_000,
            delivery_bytes: 120_000,
            pictures_sent: 3,
            gaussians: 61_000,
            steps: 800,
        }
    }

    fn comparison(methods: Vec<MethodResult>) -> Comparison {
        Comparison {
            dataset: "set".into(),
            regions: vec![("0".into(), 15, 7), ("1".into(), 12, 0)],
            steps: Some(400),
            seconds: None,
            max_gaussians: 60_000,
            scale: 0.5,
            seed: 1,
            methods,
        }
    }

    #[test]
    fn every_figure_has_its_column_and_what_is_not_there_is_a_dash() {
        let all = comparison(vec![result("dgtr", vec![40.0, 50.0], None), result("central-3dgs", vec![], None)]);
        let tables = tables(&all);
        for table in &tables {
            assert!(table.rows.len() == 2 && table.rows.iter().all(|r| r.len() == table.head.len()), "{}", table.title);
        }
        let text: String = tables.iter().map(markdown).collect();
        for figure in
            ["24.00", "24.50", "0.750", "23.00 / 23.50", " 90 |", " 50 |", "2.34", "0.120", "61 000", "400 steps"]
        {
            let thin = text.replace(['\u{202f}', '\u{2009}', ','], " ");
            assert!(thin.contains(figure), "{figure}: {thin}");
        }
        assert!(tables[0].rows[0].iter().filter(|c| *c == NONE).count() == 3, "no picture near a seam");
        assert_eq!(tables[2].rows[1][1], NONE, "no aircraft trains for a central method");
    }

    #[test]
    fn a_perceptual_column_is_there_when_a_metric_is() {
        let with = comparison(vec![result("dgtr", vec![1.0], Some(0.123))]);
        let table = &tables(&with)[0];
        assert_eq!((table.head[4].as_str(), table.rows[0][4].as_str()), ("st-lpips", "0.123"));
        let without = comparison(vec![result("dgtr", vec![1.0], None)]);
        assert!(!tables(&without)[0].head.contains(&"st-lpips".to_owned()));
    }
}
