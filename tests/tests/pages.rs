//! Documents and help keep to `.github/STYLE.md`: how long pages and sentences are, which words are ours alone, and that
//! `.github/ARCHITECTURE.md` lists the crates and modules that there are. `DGTR_BLESS=1` writes that list.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;
use std::process::Command;

use syn::Item;

/// Most words of a page.
const WORDS: [(&str, usize); 3] =
    [("README.md", 900), ("tests/BENCHMARKS.md", 1_500), (".github/ARCHITECTURE.md", 1_500)];

/// Pages that people read.
const PAGES: [&str; 12] = [
    "README.md",
    ".github/ARCHITECTURE.md",
    ".github/ARDUPILOT.md",
    ".github/CONTRIBUTING.md",
    ".github/GROUND.md",
    ".github/INSTALL.md",
    ".github/PX4.md",
    ".github/STYLE.md",
    ".github/TRUST.md",
    "models/networks/EXPORT.md",
    "tests/BENCHMARKS.md",
    "tests/DEVICES.md",
];

/// Most words of a page's or a help's mean sentence.
const MEAN: f64 = 20.0;

/// Words that only builders of this program would use, and the field's term for each.
const PRIVATE: [(&str, &str); 7] = [
    ("learnt by heart", "overfitting"),
    ("kernel shape", "kernel configuration"),
    ("shape of the kernels", "kernel configuration"),
    ("cpu twin", "reference"),
    ("rounded for delivery", "quantised"),
    ("light is even", "exposure correction is not needed"),
    ("the same as above", "say what it is"),
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace")
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Words of each sentence of a Markdown text, without code, tables, headings and pictures.
fn sentences(text: &str) -> Vec<usize> {
    let (mut blocks, mut block, mut in_code) = (Vec::new(), String::new(), false);
    for line in text.lines().map(str::trim).chain([""]) {
        in_code ^= line.starts_with("```");
        let is_item = line.starts_with("- ") || line.split_once(". ").is_some_and(|(n, _)| n.parse::<u32>().is_ok());
        let is_prose = !in_code && !line.is_empty() && !line.starts_with(['#', '|', '!', '<', '`']);
        if !is_prose || is_item {
            blocks.push(std::mem::take(&mut block));
        }
        if is_prose {
            block.push_str(line.strip_prefix("- ").unwrap_or(line));
            block.push(' ');
        }
    }
    let ends = |word: &str| word.trim_end_matches([')', '*', '"', '`']).ends_with(['.', '!', '?', ':', ';']);
    let lengths = |block: &String| {
        let is_word = |word: &&str| word.contains(char::is_alphanumeric);
        let words: Vec<&str> = block.split_whitespace().filter(is_word).collect();
        words.split_inclusive(|word| ends(word)).map(<[&str]>::len).collect::<Vec<_>>()
    };
    blocks.iter().flat_map(lengths).collect()
}

fn mean(lengths: &[usize]) -> f64 {
    lengths.iter().sum::<usize>() as f64 / lengths.len().max(1) as f64
}

/// What a help says, without usage, names of options and examples: a paragraph for each thing it explains.
fn help(arguments: &[&str]) -> String {
    let output =
        Command::new(env!("CARGO_BIN_EXE_dgtr-under-test")).args(arguments).output().expect("the program runs");
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("UTF-8");
    let mut said = String::new();
    for line in text.split("\nExample").next().unwrap_or_default().lines() {
        let (indent, line) = (line.len() - line.trim_start().len(), line.trim());
        let begins = line.is_empty() || line.starts_with(['-', '<', '[']) || (1..4).contains(&indent);
        match line.split_once("  ") {
            _ if line.starts_with("Usage:") || line.ends_with(':') => {}
            // A name, and beside it what it is.
            Some((_, about)) if begins => said += &format!(".\n\n{}\n", about.trim()),
            None if begins => said += ".\n\n",
            _ => said += &format!("{line}\n"),
        }
    }
    said
}

/// The commands of the program, but for `help`.
fn commands() -> Vec<String> {
    let output = Command::new(env!("CARGO_BIN_EXE_dgtr-under-test")).arg("--help").output().expect("the program runs");
    let text = String::from_utf8(output.stdout).expect("UTF-8");
    let indented = text.lines().filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    let names = indented.filter_map(|line| line.split_whitespace().next()).map(str::to_owned);
    names.filter(|name| name != "help" && name.chars().all(|c| c.is_ascii_lowercase())).collect()
}

#[test]
fn pages_are_no_longer_than_they_may_be() {
    for (page, most) in WORDS {
        let words = read(page).split_whitespace().count();
        assert!(words <= most, "{page} has {words} words; {most} will do");
    }
}

#[test]
fn the_mean_sentence_of_every_page_is_short() {
    for page in PAGES {
        let lengths = sentences(&read(page));
        assert!(lengths.len() > 3, "{page} has sentences");
        assert!(mean(&lengths) <= MEAN, "{page}: {:.1} words a sentence", mean(&lengths));
    }
}

#[test]
fn the_mean_sentence_of_every_help_is_short() {
    let commands = commands();
    assert!(commands.len() > 12, "{commands:?}");
    for command in commands {
        let lengths = sentences(&help(&[&command, "--help"]));
        assert!(!lengths.is_empty(), "{command} explains itself");
        assert!(mean(&lengths) <= MEAN, "dgtr {command} --help: {:.1} words a sentence", mean(&lengths));
    }
}

#[test]
fn pages_and_help_use_the_terms_of_the_field() {
    // The page of style itself names what is not to be written.
    let pages = PAGES.iter().filter(|page| !page.ends_with("STYLE.md")).map(|page| (page.to_string(), read(page)));
    let helps = commands().into_iter().map(|name| (format!("dgtr {name} --help"), help(&[&name, "--help"])));
    for (name, text) in pages.chain(helps) {
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase();
        for (private, term) in PRIVATE {
            assert!(!text.contains(private), "{name} says \"{private}\"; the field's term is: {term}");
        }
    }
}

#[test]
fn sentences_are_counted_without_code_and_tables() {
    let text = "# A title\n\nOne two three. Four five!\n\n```sh\nnot this. nor this.\n```\n| no | table |\n- six seven\n- eight: nine";
    assert_eq!(sentences(text), [3, 2, 2, 1, 1]);
}

/// Top-level modules that a crate is built of, tests apart.
fn modules(folder: &str) -> Vec<String> {
    let file = syn::parse_file(&read(&format!("{folder}/src/lib.rs"))).expect("Rust");
    let for_tests = |attribute: &syn::Attribute| {
        let list = attribute.meta.require_list().map(|l| l.tokens.to_string()).unwrap_or_default();
        attribute.path().is_ident("cfg") && list.split(|c: char| !c.is_alphanumeric()).any(|word| word == "test")
    };
    let mut names: Vec<String> = file
        .items
        .iter()
        .filter_map(|item| match item {
            Item::Mod(module) if !module.attrs.iter().any(for_tests) => Some(module.ident.to_string()),
            _ => None,
        })
        .collect();
    names.sort();
    names
}

/// A row for each member of the workspace that has a library: folder, what its manifest says of it, its modules.
fn crates() -> String {
    let manifest = |folder: &str| read(&format!("{folder}Cargo.toml")).parse::<toml::Table>().expect("TOML");
    let workspace = manifest("");
    let members = workspace["workspace"]["members"].as_array().expect("members").iter().filter_map(|m| m.as_str());
    let mut rows = String::from("| crate | subject | modules |\n|---|---|---|\n");
    for folder in members.filter(|folder| root().join(folder).join("src/lib.rs").is_file()) {
        let package = &manifest(&format!("{folder}/"))["package"];
        let about = package["description"].as_str().expect("a description");
        rows += &format!("| `{folder}` | {about} | {} |\n", modules(folder).join(", "));
    }
    rows
}

#[test]
fn the_architecture_lists_the_crates_and_modules_that_there_are() {
    const MARKS: [&str; 2] = ["<!-- crates -->\n", "<!-- /crates -->"];
    let page = read(".github/ARCHITECTURE.md");
    let (before, rest) = page.split_once(MARKS[0]).expect("the list begins");
    let (_, after) = rest.split_once(MARKS[1]).expect("the list ends");
    let wanted = format!("{before}{}{}{}{after}", MARKS[0], crates(), MARKS[1]);
    if std::env::var_os("DGTR_BLESS").is_some() {
        std::fs::write(root().join(".github/ARCHITECTURE.md"), &wanted).expect("written");
    } else {
        assert!(page == wanted, ".github/ARCHITECTURE.md is older than the crates: DGTR_BLESS=1 remakes its list");
    }
}
