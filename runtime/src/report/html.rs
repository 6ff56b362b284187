//! The page: sections in reading order, escaped text, figures as people write them.

use std::fmt::Write;

use super::text::{bytes, count, escape, seconds};
use super::{Comparison, ModelRow, ReportData, ReportError, Table, Timing, map, picture};

/// Colours for aircraft; beyond them they repeat.
pub(super) const COLOURS: usize = 6;
/// Colour class of what belongs to nobody in particular.
pub(super) const NEUTRAL: usize = 6;

fn or_dash<T>(value: Option<T>, show: impl Fn(T) -> String) -> String {
    value.map_or_else(|| "–".into(), show)
}

pub(super) fn page(data: &ReportData) -> Result<String, ReportError> {
    let mut out = String::new();
    let title = escape(&data.title);
    // Writing into a String cannot fail.
    let _ = write!(
        out,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>{title}</title>\
         <style>{}</style></head><body><main><header><h1>{title}</h1><p class=\"sub\">{}</p></header>\n",
        include_str!("style.css"),
        escape(&data.subtitle)
    );
    if !data.headline.is_empty() {
        out.push_str("<dl class=\"tiles\">");
        for (label, value) in &data.headline {
            let _ = write!(out, "<div><dt>{}</dt><dd>{}</dd></div>", escape(label), escape(value));
        }
        out.push_str("</dl>\n");
    }
    warnings(&mut out, &data.warnings);
    if let Some(svg) = map::svg(data) {
        let _ = writeln!(out, "<h2>Regions and cameras</h2><div class=\"card map\">{svg}</div>");
    }
    models(&mut out, data);
    comparisons(&mut out, &data.comparisons)?;
    timings(&mut out, data);
    for chart in &data.charts {
        if let Some(svg) = chart.svg(false) {
            let _ = writeln!(out, "<h2>{}</h2><div class=\"card\">{svg}</div>", escape(&chart.title));
        }
    }
    for t in &data.tables {
        table(&mut out, t);
    }
    if !data.skipped.is_empty() {
        let rows = data.skipped.iter().map(|(what, n)| vec![what.clone(), count(*n)]).collect();
        let note = "Work that the scene did not need, and input that could not be used.".into();
        table(&mut out, &Table { title: "Skipped".into(), note, head: vec!["what".into(), "count".into()], rows });
    }
    if !data.files.is_empty() {
        out.push_str("<h2>Files</h2><ul class=\"files\">");
        for (what, path) in &data.files {
            let _ = write!(out, "<li>{}: <code>{}</code></li>", escape(what), escape(&path.display().to_string()));
        }
        out.push_str("</ul>\n");
    }
    let _ = writeln!(out, "<footer>dgtr {}</footer></main></body></html>", env!("CARGO_PKG_VERSION"));
    Ok(out)
}

fn warnings(out: &mut String, warnings: &[String]) {
    if warnings.is_empty() {
        return;
    }
    out.push_str("<div class=\"warn\" role=\"note\"><strong>Please note</strong><ul>");
    for w in warnings {
        let _ = write!(out, "<li>{}</li>", escape(w));
    }
    out.push_str("</ul></div>\n");
}

/// A column of the model table: head and cell.
type Column = (&'static str, fn(&ModelRow) -> String, fn(&ModelRow) -> bool);

const COLUMNS: [Column; 8] = [
    ("views", |r| or_dash(r.views, count), |r| r.views.is_some()),
    ("Gaussians", |r| or_dash(r.gaussians, count), |r| r.gaussians.is_some()),
    ("steps", |r| or_dash(r.steps, count), |r| r.steps.is_some()),
    ("time", |r| or_dash(r.seconds, seconds), |r| r.seconds.is_some()),
    ("PSNR, dB", |r| or_dash(r.psnr.filter(|v| v.is_finite()), |v| format!("{v:.2}")), |r| r.psnr.is_some()),
    ("SSIM", |r| or_dash(r.ssim.filter(|v| v.is_finite()), |v| format!("{v:.3}")), |r| r.ssim.is_some()),
    ("uploaded", |r| or_dash(r.uploaded, bytes), |r| r.uploaded.is_some()),
    ("pictures", |r| or_dash(r.pictures, bytes), |r| r.pictures.is_some()),
];

fn models(out: &mut String, data: &ReportData) {
    if data.models.is_empty() {
        return;
    }
    let columns: Vec<&Column> = COLUMNS.iter().filter(|c| data.models.iter().any(c.2)).collect();
    out.push_str("<h2>Models</h2><div class=\"card\"><table><thead><tr><th></th>");
    for c in &columns {
        let _ = write!(out, "<th>{}</th>", c.0);
    }
    out.push_str("</tr></thead><tbody>");
    for row in &data.models {
        let colour = data.colour(&row.name);
        let total = if row.name == "global" { " class=\"total\"" } else { "" };
        let _ = write!(out, "<tr{total}><td><span class=\"dot k{colour}\"></span>{}</td>", escape(&row.name));
        for c in &columns {
            let _ = write!(out, "<td>{}</td>", c.1(row));
        }
        out.push_str("</tr>");
    }
    out.push_str("</tbody></table></div>\n");
}

fn comparisons(out: &mut String, comparisons: &[Comparison]) -> Result<(), ReportError> {
    if comparisons.is_empty() {
        return Ok(());
    }
    out.push_str("<h2>Pictures</h2><div class=\"views\">");
    for c in comparisons {
        let _ =
            write!(out, "<figure><h3>{}<span>{}</span></h3><div class=\"panels\">", escape(&c.title), escape(&c.note));
        for (label, image) in &c.panels {
            let uri =
                picture::data_uri(image).map_err(|source| ReportError::Picture { name: c.title.clone(), source })?;
            let label = escape(label);
            let _ = write!(
                out,
                "<div><img src=\"{uri}\" width=\"{}\" height=\"{}\" alt=\"{label}\"><small>{label}</small></div>",
                image.width(),
                image.height()
            );
        }
        out.push_str("</div></figure>");
    }
    out.push_str("</div>\n");
    Ok(())
}

fn timings(out: &mut String, data: &ReportData) {
    let longest = data.timings.iter().map(|t| t.seconds).filter(|s| s.is_finite()).fold(0.0, f64::max);
    if longest <= 0.0 {
        return;
    }
    out.push_str("<h2>Where the time went</h2><div class=\"card bars\">");
    for Timing { name, of, seconds: s } in data.timings.iter().filter(|t| t.seconds.is_finite()) {
        let share = (100.0 * s / longest).clamp(0.0, 100.0);
        let whose = if of.is_empty() { String::new() } else { format!("{} · ", escape(of)) };
        let _ = write!(
            out,
            "<span>{whose}{}</span><span><i class=\"k{}\" style=\"width:{share:.1}%\"></i></span><b>{}</b>",
            escape(name),
            data.colour(of),
            seconds(*s)
        );
    }
    out.push_str("</div>\n");
}

fn table(out: &mut String, t: &Table) {
    let _ = write!(out, "<h2>{}</h2>", escape(&t.title));
    if !t.note.is_empty() {
        let _ = write!(out, "<p class=\"note\">{}</p>", escape(&t.note));
    }
    out.push_str("<div class=\"card\"><table><thead><tr>");
    for h in &t.head {
        let _ = write!(out, "<th>{}</th>", escape(h));
    }
    out.push_str("</tr></thead><tbody>");
    for row in &t.rows {
        out.push_str("<tr>");
        for cell in row {
            let _ = write!(out, "<td>{}</td>", escape(cell));
        }
        out.push_str("</tr>");
    }
    out.push_str("</tbody></table></div>\n");
}
