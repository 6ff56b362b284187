//! Tables for other programs.

use pages::report::Table;

/// The table as RFC 4180 CSV, head first.
pub fn csv(table: &Table) -> String {
    let cell = |text: &String| match text.contains([',', '"', '\n']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.clone(),
    };
    let line = |cells: &Vec<String>| cells.iter().map(cell).collect::<Vec<_>>().join(",") + "\r\n";
    std::iter::once(&table.head).chain(&table.rows).map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_quotes_what_needs_it() {
        let head = vec!["what".into(), "n".into()];
        let table = Table { head, rows: vec![vec!["a, \"b\"".into(), "1".into()]], ..Table::default() };
        assert_eq!(csv(&table), "what,n\r\n\"a, \"\"b\"\"\",1\r\n");
    }
}
