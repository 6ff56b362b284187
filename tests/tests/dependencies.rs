//! What may be built in: licences, sources and crates of every dependency for this platform, as `cargo metadata` knows them.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::process::Command;

use serde_json::Value;

/// Licences that Apache-2.0 code may be linked with. MPL-2.0 covers its own files only; IJG (a JPEG encoder's tables, by way of the
/// GeoTIFF writer) asks for the sentence that ends the README.
const LICENCES: [&str; 14] = [
    "Apache-2.0",
    "MIT",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "ISC",
    "Zlib",
    "0BSD",
    "Unicode-3.0",
    "CC0-1.0",
    "Unlicense",
    "BSL-1.0",
    "MPL-2.0",
    "CDLA-Permissive-2.0",
    "IJG",
];

/// Crates that must not come in, not even by way of another, with the reason.
const BANNED: [(&str, &str); 5] = [
    ("openssl-sys", "a system library; TLS is rustls"),
    ("libudev-sys", "a system library that a bare companion computer lacks"),
    ("native-tls", "TLS is rustls"),
    ("cmake", "a build needs Rust and a C compiler, nothing else"),
    ("bindgen", "a build needs no libclang"),
];

/// Advisories of RustSec that are lived with, and why.
const LIVED_WITH: [(&str, &str); 3] = [
    (
        "RUSTSEC-2026-0041",
        "zenoh-transport 1.10.2, the newest, asks for lz4_flex 0.10 and calls it with its feature transport_compression only, which is off",
    ),
    (
        "RUSTSEC-2024-0436",
        "paste, a macro that token-cell (of zenoh 1.10.2, the newest) and simba (of nalgebra 0.34) run while they are \
         compiled; nobody maintains it, nothing is wrong with it",
    ),
    (
        "RUSTSEC-2025-0134",
        "rustls-pemfile, with which zenoh-link-tls 1.10.2, the newest, reads our own certificates; nobody maintains it, nothing is wrong with it",
    ),
];

/// The newest list that was at hand; `tests/advisories.py` writes it.
const ADVISORIES: &str = include_str!("../data/advisories.txt");

const REGISTRY: &str = "registry+https://github.com/rust-lang/crates.io-index";

fn packages() -> Vec<Value> {
    let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml");
    let platform = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--locked", "--filter-platform", &platform])
        .args(["--manifest-path", manifest])
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut metadata: Value = serde_json::from_slice(&output.stdout).expect("cargo speaks JSON");
    let used: Vec<Value> =
        metadata["resolve"]["nodes"].as_array().expect("nodes").iter().map(|n| n["id"].clone()).collect();
    let packages = metadata["packages"].take();
    let packages: Vec<Value> =
        packages.as_array().expect("packages").iter().filter(|p| used.contains(&p["id"])).cloned().collect();
    assert!(packages.len() > 100, "{} packages: is this the whole workspace?", packages.len());
    packages
}

fn allowed(licence: &str) -> Result<bool, spdx::ParseError> {
    // Old manifests write "MIT/Apache-2.0".
    let expression = spdx::Expression::parse_mode(licence, spdx::ParseMode::LAX)?;
    Ok(expression.evaluate(|r| r.license.id().is_some_and(|id| LICENCES.contains(&id.name))))
}

#[test]
fn every_dependency_has_a_licence_that_may_be_linked_with_and_comes_from_crates_io() {
    let mut wrong = Vec::new();
    for p in packages() {
        let name = format!("{} {}", p["name"], p["version"]);
        match p["license"].as_str() {
            None => wrong.push(format!("{name}: states no licence")),
            Some(licence) if !allowed(licence).unwrap_or(false) => wrong.push(format!("{name}: licence {licence}")),
            Some(_) => {}
        }
        // No source: a crate of this workspace.
        if p["source"].as_str().is_some_and(|source| source != REGISTRY) {
            wrong.push(format!("{name}: from {}", p["source"]));
        }
        if let Some((_, why)) = BANNED.iter().find(|b| p["name"] == b.0) {
            wrong.push(format!("{name}: {why}"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The advisories that this version of a crate is affected by.
fn affecting(name: &str, version: &str) -> Vec<&'static str> {
    let version = semver::Version::parse(version).expect("a version");
    let is_good = |range: &str| semver::VersionReq::parse(range).expect(range).matches(&version);
    let about = ADVISORIES.lines().skip(1).filter_map(|line| {
        let mut words = line.split(' ');
        let (id, about) = (words.next()?, words.next()?);
        let good = words.next().unwrap_or_default();
        (about == name && !good.split('|').filter(|r| !r.is_empty()).any(is_good)).then_some(id)
    });
    about.collect()
}

#[test]
fn no_dependency_has_an_advisory_that_is_not_lived_with_for_a_reason() {
    println!("{}", ADVISORIES.lines().next().expect("a date"));
    let (mut wrong, mut met) = (Vec::new(), Vec::new());
    // Of all platforms: what is locked may be built somewhere.
    let lock: toml::Table = include_str!("../../Cargo.lock").parse().expect("a lock file");
    for package in lock["package"].as_array().expect("packages") {
        let word = |key: &str| package.get(key).and_then(toml::Value::as_str).unwrap_or_default();
        let (name, version) = (word("name"), word("version"));
        for id in affecting(name, version) {
            match LIVED_WITH.iter().any(|l| l.0 == id) {
                true => met.push(id),
                false => wrong.push(format!("{name} {version}: https://rustsec.org/advisories/{id}")),
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    for (id, why) in LIVED_WITH {
        assert!(met.contains(&id), "{id} does not concern us any more: take it off ({why})");
    }
}

#[test]
fn an_advisory_concerns_the_versions_it_names() {
    assert_eq!(affecting("lz4_flex", "0.10.0"), ["RUSTSEC-2026-0041"]);
    assert_eq!(affecting("lz4_flex", "0.12.0"), ["RUSTSEC-2026-0041"]);
    for mended in ["0.11.6", "0.12.1", "0.13.0"] {
        assert_eq!(affecting("lz4_flex", mended), [""; 0], "{mended}");
    }
    assert_eq!(affecting("paste", "1.0.15"), ["RUSTSEC-2024-0436"], "where no version is good, all are meant");
    assert!(ADVISORIES.lines().count() > 1000 && ADVISORIES.lines().skip(1).all(|l| l.starts_with("RUSTSEC-")));
}

#[test]
fn a_licence_is_judged_as_the_expression_it_is() {
    for (licence, good) in [
        ("MIT OR GPL-3.0-only", true),
        ("MIT AND GPL-3.0-only", false),
        ("MIT/Apache-2.0", true),
        ("(MIT OR Apache-2.0) AND Unicode-3.0", true),
        ("Apache-2.0 WITH LLVM-exception", true),
        ("AGPL-3.0-or-later", false),
    ] {
        assert_eq!(allowed(licence).expect(licence), good, "{licence}");
    }
}
