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
