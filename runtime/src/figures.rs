//! Figures as Markdown on standard output, as JSON, and with three digits.

use std::path::Path;

use models::formats::write_atomic;
use pages::report::Table;
use serde::Serialize;

use crate::error::JobError;

/// The table as GitHub writes tables: first column text, the others right-aligned figures.
pub fn markdown(table: &Table) -> String {
    let mut out = String::new();
    if !table.title.is_empty() {
        out += &format!("### {}\n\n", table.title);
    }
    if !table.note.is_empty() {
        out += &format!("{}\n\n", table.note);
    }
    let widths: Vec<usize> = (0..table.head.len())
        .map(|c| {
            let cells = table.rows.iter().filter_map(|r| r.get(c));
            cells.chain([&table.head[c]]).map(|t| t.chars().count()).max().unwrap_or(0).max(3)
        })
        .collect();
    let mut line = |cells: &[String]| {
        out += "|";
        for (c, width) in widths.iter().enumerate() {
            let text = cells.get(c).map_or("", String::as_str).replace('|', "\\|");
            out += &if c == 0 { format!(" {text:<width$} |") } else { format!(" {text:>width$} |") };
        }
        out.push('\n');
    };
    line(&table.head);
    let rule = |(c, w): (usize, &usize)| if c == 0 { "-".repeat(*w) } else { "-".repeat(w - 1) + ":" };
    line(&widths.iter().enumerate().map(rule).collect::<Vec<_>>());
    table.rows.iter().for_each(|r| line(r));
    out
}

/// Writes `text` to `path`, atomically.
///
/// # Errors
/// The file cannot be written.
pub fn write_text(path: &Path, text: &str) -> Result<(), JobError> {
    Ok(write_atomic(path, |out| out.write_all(text.as_bytes()))?)
}

/// Writes `value` as JSON to `path`, atomically.
///
/// # Errors
/// The file cannot be written.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), JobError> {
    let text = serde_json::to_string_pretty(value)?;
    write_text(path, &(text + "\n"))
}

/// A figure with three significant digits, as short as it can be; a dash when there is none.
pub fn short(value: f64) -> String {
    if !value.is_finite() {
        return "–".into();
    }
    let digits = if value == 0.0 { 0 } else { (2 - value.abs().log10().floor() as i32).clamp(0, 6) };
    format!("{value:.*}", digits as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        Table {
            title: "T".into(),
            note: String::new(),
            head: vec!["what".into(), "n".into()],
            rows: vec![vec!["a, \"b\"".into(), "1".into()]],
        }
    }

    #[test]
    fn markdown_aligns_figures() {
        let text = markdown(&table());
        assert!(text.contains("| ------ | --: |") && text.contains("| a, \"b\" |   1 |"), "{text}");
    }

    #[test]
    fn figures_keep_three_digits() {
        for (value, text) in [(0.012_345, "0.0123"), (1.2345, "1.23"), (123.4, "123"), (0.0, "0"), (f64::NAN, "–")] {
            assert_eq!(short(value), text);
        }
    }
}
