//! Measured results have one home, `tests/results/*.json`. `tests/BENCHMARKS.md` and the table of results in `README.md` are written
//! from it by `DGTR_BLESS=1 cargo test --release -p tests --test results`, and without that variable compared with it.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::de::DeserializeOwned;

/// The tables, in the order of the page.
const TABLES: [&str; 10] =
    ["fleet", "methods", "time-error", "first-gaussians", "poses", "steps", "skips", "limits", "delivery", "map"];

/// Words of the page, at most.
const MOST_WORDS: usize = 1_500;

/// Words of one sentence, at most.
const LONGEST_SENTENCE: usize = 25;

const INTRODUCTION: &str = "# Results

Each table answers one question and names its command, its commit and its machine. PSNR (dB) and SSIM are of held-out pictures; `–` was not
measured. Data sets are folders given by path, and `dgtr` is `runtime/dgtr.sh`. Ideas that did not work are in [TRIED.md](results/TRIED.md),
boards and cards in [DEVICES.md](DEVICES.md), kernels by driver in [boards.md](data/boards.md).

This page is written from [results/](results/): `DGTR_BLESS=1 cargo test --release -p tests --test results`.
";

/// One file of `tests/results/`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    title: String,
    /// What is compared, and what the answer means.
    question: String,
    /// Shell commands, one a line.
    command: String,
    /// Of most rows; a column of commits names the others.
    commit: String,
    /// A key of `machines.json`.
    machine: String,
    columns: Vec<Column>,
    rows: Vec<Vec<Option<Cell>>>,
    /// The line of it that the README shows.
    headline: Option<Headline>,
    /// What the table does not show.
    note: Option<String>,
    /// Path of a picture, from `tests/`.
    picture: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Column {
    name: String,
    unit: String,
    /// Digits after the point; as many as a number needs, where absent.
    decimals: Option<usize>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Cell {
    Number(f64),
    Text(String),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Headline {
    what: String,
    result: String,
}

impl Column {
    fn heading(&self) -> String {
        if self.unit.is_empty() { self.name.clone() } else { format!("{}, {}", self.name, self.unit) }
    }

    fn shown(&self, cell: Option<&Cell>) -> String {
        match cell {
            None => "–".to_owned(),
            Some(Cell::Text(text)) => text.clone(),
            Some(Cell::Number(number)) => {
                let shown = self.decimals.map_or_else(|| number.to_string(), |d| format!("{number:.d$}"));
                shown.replace('-', "−")
            }
        }
    }
}

impl Table {
    fn read(name: &str) -> Self {
        let table: Self = json(&format!("{name}.json"));
        for row in &table.rows {
            assert_eq!(row.len(), table.columns.len(), "{name}.json: a row has a cell for each column");
        }
        let commits = table.columns.iter().position(|c| c.name == "commit");
        let in_rows = table.rows.iter().filter_map(|row| match row.get(commits?) {
            Some(Some(Cell::Text(commit))) => Some(commit.as_str()),
            _ => panic!("{name}.json: a row names its commit"),
        });
        for commit in in_rows.chain([table.commit.as_str()]) {
            let hash = commit.len() == 7 && commit.bytes().all(|b| b.is_ascii_hexdigit());
            assert!(hash, "{name}.json: {commit} is no abbreviated commit");
        }
        table
    }

    /// The cells as the page shows them, row by row.
    fn cells(&self) -> impl Iterator<Item = Vec<String>> {
        self.rows.iter().map(|row| row.iter().zip(&self.columns).map(|(cell, c)| c.shown(cell.as_ref())).collect())
    }

    fn write(&self, page: &mut String) {
        let row = |cells: Vec<String>| format!("|{}|\n", cells.join("|"));
        let Self { title, question, command, commit, machine, .. } = self;
        let _ = write!(page, "\n## {title}\n\n{question}\n\n");
        page.push_str(&row(self.columns.iter().map(Column::heading).collect()));
        page.push_str(&format!("|{}\n", "---|".repeat(self.columns.len())));
        self.cells().for_each(|cells| page.push_str(&row(cells)));
        if let Some(picture) = &self.picture {
            let _ = write!(page, "\n![{title}]({picture})\n");
        }
        let note = self.note.as_ref().map_or_else(String::new, |n| format!(" {n}"));
        let by_row = self.columns.iter().any(|c| c.name == "commit");
        let commit = if by_row { String::new() } else { format!(" at `{commit}`") };
        let _ = write!(page, "\nMeasured on {machine}{commit}.{note}\n\n```sh\n{command}\n```\n");
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

fn json<T: DeserializeOwned>(name: &str) -> T {
    serde_json::from_str(&read(&format!("tests/results/{name}")))
        .unwrap_or_else(|e| panic!("tests/results/{name}: {e}"))
}

fn tables() -> Vec<Table> {
    TABLES.map(Table::read).into()
}

/// Compares a file with what it should be, or writes it where asked to.
fn agrees(path: &str, wanted: &str) {
    if std::env::var_os("DGTR_BLESS").is_some() {
        std::fs::write(root().join(path), wanted).unwrap_or_else(|e| panic!("{path}: {e}"));
    }
    assert!(read(path) == wanted, "{path} is older than tests/results: DGTR_BLESS=1 remakes it");
}

/// Numbers in a text; a comma between digits groups them.
fn numbers(text: &str) -> Vec<f64> {
    let text = text.replace('−', "-");
    let words = text.split(|c: char| !c.is_ascii_digit() && !matches!(c, '.' | ',' | '-'));
    words.filter_map(|word| word.trim_matches(['.', ',']).replace(',', "").parse().ok()).collect()
}

fn words(text: &str) -> usize {
    text.split(|c: char| c.is_whitespace() || c == '|').filter(|w| w.contains(char::is_alphanumeric)).count()
}

#[test]
fn the_page_of_results_is_what_the_files_say() {
    let mut files: Vec<String> = std::fs::read_dir(root().join("tests/results"))
        .expect("tests/results is there")
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("a name in UTF-8"))
        .filter(|name| name.ends_with(".json"))
        .collect();
    files.sort();
    let mut wanted: Vec<String> = TABLES.iter().chain(&["machines"]).map(|name| format!("{name}.json")).collect();
    wanted.sort();
    assert_eq!(files, wanted, "each table has its file, and each file its place on the page");

    let machines: BTreeMap<String, String> = json("machines.json");
    let tables = tables();
    let mut page = INTRODUCTION.to_owned();
    for (name, what) in &machines {
        assert!(tables.iter().any(|t| t.machine == *name), "machines.json: {name} measured nothing");
        let _ = write!(page, "\n- *{name}*: {what}");
    }
    page.push('\n');
    for table in &tables {
        assert!(machines.contains_key(&table.machine), "{}: {} is not in machines.json", table.title, table.machine);
        table.write(&mut page);
    }
    agrees("tests/BENCHMARKS.md", &page);
    assert!(words(&page) <= MOST_WORDS, "BENCHMARKS.md has {} words of at most {MOST_WORDS}", words(&page));
}

#[test]
fn the_page_is_in_short_sentences_and_its_links_lead_somewhere() {
    for table in tables() {
        for text in [Some(table.question), table.note].into_iter().flatten() {
            let longest = text.split(". ").flat_map(|s| s.split("? ")).map(words).max().unwrap_or(0);
            assert!(longest <= LONGEST_SENTENCE, "{}: a sentence of {longest} words", table.title);
        }
    }
    for link in read("tests/BENCHMARKS.md").split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
        assert!(root().join("tests").join(link).exists(), "BENCHMARKS.md leads to {link}, which is not there");
    }
}

#[test]
fn a_headline_holds_no_number_that_its_table_lacks() {
    for table in tables() {
        let Some(headline) = &table.headline else { continue };
        let measured: Vec<f64> = table.cells().flatten().flat_map(|cell| numbers(&cell)).collect();
        let headings = table.columns.iter().flat_map(|c| numbers(&c.name));
        let given: Vec<f64> = headings.chain(numbers(&table.question)).chain(numbers(&table.command)).collect();
        for number in numbers(&headline.result) {
            assert!(measured.contains(&number), "{}: {number} of the headline is in no row", table.title);
        }
        for number in numbers(&headline.what) {
            let known = measured.contains(&number) || given.contains(&number);
            assert!(known, "{}: {number} of the headline is nowhere in the table", table.title);
        }
    }
}

#[test]
fn the_readme_shows_the_headlines() {
    const MARKS: [&str; 2] = ["<!-- results -->\n", "<!-- /results -->"];
    let readme = read("README.md");
    let (before, rest) = readme.split_once(MARKS[0]).expect("README.md marks where its results begin");
    let (_, after) = rest.split_once(MARKS[1]).expect("README.md marks where its results end");
    let headlines: Vec<Headline> = tables().into_iter().filter_map(|t| t.headline).collect();
    let rows: String = headlines.iter().map(|h| format!("| {} | {} |\n", h.what, h.result)).collect();
    let [begin, end] = MARKS;
    agrees("README.md", &format!("{before}{begin}| what | result |\n|---|---|\n{rows}{end}{after}"));
}
