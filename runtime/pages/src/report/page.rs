//! The page and the state it draws: figures are written here as people write them, the script only places them.

use serde_json::{Value, json};

use super::text::{bytes, count, escape, seconds};
use super::{ModelRow, ReportData, ReportError, picture};

/// The page's style.
pub const STYLE: &str = include_str!("page.css");
/// What draws it.
pub const SCRIPT: &str = include_str!("page.js");
/// Title, head, body and foot are put in.
const PAGE: &str = include_str!("page.html");
/// A report asks nobody for anything, whatever is written into it.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:";

fn or_dash<T>(value: Option<T>, show: impl Fn(T) -> String) -> String {
    value.map_or_else(|| "–".into(), show)
}

/// The page with these in its places, in one pass: what is put in is not looked through again.
fn filled(title: &str, subtitle: &str, head: &str, foot: &str) -> String {
    let (title, subtitle) = (escape(title), escape(subtitle));
    let (mut page, mut rest) = (String::new(), PAGE);
    while let Some((before, (name, after))) = rest.split_once('{').and_then(|(b, a)| Some((b, a.split_once('}')?))) {
        page.push_str(before);
        page.push_str(match name {
            "title" => &title,
            "subtitle" => &subtitle,
            "head" => head,
            "foot" => foot,
            _ => env!("CARGO_PKG_VERSION"),
        });
        rest = after;
    }
    page + rest
}

/// The live page, as it is before it has heard of anything, with style and script to be fetched beside it.
pub fn live() -> String {
    let style = "<link rel=\"stylesheet\" href=\"page.css\">";
    filled("dgtr", "", style, "<script src=\"page.js\" defer></script>")
}

/// JSON that may stand in a script element: there `<` could end it.
fn embedded(value: &impl serde::Serialize) -> String {
    // Numbers, texts and lists: there is nothing that JSON could not hold.
    serde_json::to_string(value).unwrap_or_default().replace('<', "\\u003c")
}

/// The page with its state inside.
pub(super) fn frozen(data: &ReportData) -> Result<String, ReportError> {
    let state = embedded(&state(data, true)?);
    let head = format!("<meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\"><style>{STYLE}</style>");
    let ground = embedded(&data.ground);
    let inside = |id: &str, json: &str| format!("<script type=\"application/json\" id=\"{id}\">{json}</script>\n");
    let foot = [inside("state", &state), inside("ground", &ground), format!("<script>{SCRIPT}</script>")].concat();
    Ok(filled(&data.title, &data.subtitle, &head, &foot))
}

/// What the page draws, but for the ground.
pub(super) fn state(data: &ReportData, frozen: bool) -> Result<Value, ReportError> {
    let side_by_side = data.comparisons.iter().filter(|_| frozen).map(|c| {
        let panel = |(label, image): &(String, image::RgbImage)| {
            let src = picture::data_uri(image).map_err(ReportError::picture(&c.title))?;
            Ok(json!({ "label": label, "src": src, "width": image.width(), "height": image.height() }))
        };
        let panels = c.panels.iter().map(panel).collect::<Result<Vec<_>, ReportError>>()?;
        Ok(json!({ "title": c.title, "note": c.note, "panels": panels }))
    });
    let aircraft = data.aircraft.iter().map(|craft| craft.json(frozen));
    let finite = |points: &[[f64; 2]]| -> Vec<[f64; 2]> {
        points.iter().filter(|p| p[0].is_finite() && p[1].is_finite()).copied().collect()
    };
    let regions = data
        .map
        .iter()
        .map(|r| json!({ "name": r.name, "corners": finite(&r.corners), "cameras": finite(&r.cameras) }));
    let charts =
        data.charts.iter().filter_map(|c| Some(json!({ "title": c.title, "src": picture::svg_uri(&c.svg(true)?) })));
    let tables =
        data.tables.iter().map(|t| json!({ "title": t.title, "note": t.note, "head": t.head, "rows": t.rows }));
    let skipped: Vec<_> = data.skipped.iter().map(|(what, n)| [what.clone(), count(*n)]).collect();
    let files: Vec<_> = data.files.iter().map(|(what, path)| [what.clone(), path.display().to_string()]).collect();
    Ok(json!({
        "title": data.title,
        "subtitle": data.subtitle,
        "headline": data.headline,
        "warnings": data.warnings,
        "regions": regions.collect::<Vec<_>>(),
        "aircraft": aircraft.collect::<Result<Vec<_>, _>>()?,
        "models": models(&data.models),
        "comparisons": side_by_side.collect::<Result<Vec<_>, ReportError>>()?,
        "timings": timings(data),
        "charts": charts.collect::<Vec<_>>(),
        "tables": tables.collect::<Vec<_>>(),
        "skipped": skipped,
        "files": files,
    }))
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

/// Head and rows, without the columns of which nothing is known.
fn models(models: &[ModelRow]) -> Value {
    let columns: Vec<&Column> = COLUMNS.iter().filter(|c| models.iter().any(c.2)).collect();
    let head: Vec<&str> = std::iter::once("model").chain(columns.iter().map(|c| c.0)).collect();
    let row = |r: &ModelRow| std::iter::once(r.name.clone()).chain(columns.iter().map(|c| c.1(r))).collect();
    let rows: Vec<Vec<String>> = models.iter().map(row).collect();
    json!({ "head": head, "rows": rows })
}

fn timings(data: &ReportData) -> Vec<Value> {
    let known = || data.timings.iter().filter(|t| t.seconds.is_finite());
    let longest = known().map(|t| t.seconds).fold(0.0, f64::max);
    let bar = |t: &super::Timing| json!({ "name": t.name, "of": t.of, "share": (t.seconds / longest).clamp(0.0, 1.0), "text": seconds(t.seconds) });
    known().filter(|_| longest > 0.0).map(bar).collect()
}
