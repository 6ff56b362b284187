//! The checked-in SPIR-V belongs to the GLSL beside it: `spirv/sources.txt` holds a hash of every source it was made
//! from, and where the same `glslangValidator` is installed the bytes are compared too. `DGTR_BLESS=1` remakes both.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn shaders() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders")
}

/// The text with its includes in place: what is compiled depends on nothing but files of this folder.
fn expanded(file: &Path) -> String {
    let mut out = String::new();
    for line in fs::read_to_string(file).unwrap().lines() {
        match line.strip_prefix("#include \"").and_then(|rest| rest.strip_suffix('"')) {
            Some(name) => out += &expanded(&shaders().join(name)),
            None => {
                out += line;
                out.push('\n');
            }
        }
    }
    out
}

/// FNV-1a, 64 bit.
fn hash(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3))
}

/// The compiler's version line; `None` when it is not installed.
fn compiler() -> Option<String> {
    let said = Command::new("glslangValidator").arg("--version").output().ok()?;
    String::from_utf8_lossy(&said.stdout).lines().next().map(str::to_owned)
}

fn compile(source: &Path, to: &Path) {
    let target = ["-V", "--target-env", "vulkan1.1", "-o"];
    let done = Command::new("glslangValidator").args(target).arg(to).arg(source).output().unwrap();
    assert!(done.status.success(), "{}: {}", source.display(), String::from_utf8_lossy(&done.stdout));
}

#[test]
fn checked_in_spirv_is_what_the_sources_compile_to() {
    let (bless, compiler) = (std::env::var_os("DGTR_BLESS").is_some(), compiler());
    let spirv = shaders().join("spirv");
    let list = spirv.join("sources.txt");
    let mut sources: Vec<PathBuf> = fs::read_dir(shaders()).unwrap().map(|e| e.unwrap().path()).collect();
    sources.retain(|p| p.extension().is_some_and(|e| e == "comp"));
    sources.sort();
    let stored = |source: &Path| spirv.join(source.file_stem().unwrap()).with_extension("spv");
    if bless {
        let mut text = compiler.clone().unwrap() + "\n";
        for source in &sources {
            compile(source, &stored(source));
            writeln!(text, "{:016x} {}", hash(&expanded(source)), source.file_name().unwrap().display()).unwrap();
        }
        fs::write(&list, text).unwrap();
    }
    let text = fs::read_to_string(&list).unwrap();
    let (made_by, hashes) = text.split_once('\n').unwrap();
    let fresh = sources.iter().fold(String::new(), |mut all, s| {
        writeln!(all, "{:016x} {}", hash(&expanded(s)), s.file_name().unwrap().display()).unwrap();
        all
    });
    assert!(hashes == fresh, "the SPIR-V is older than its sources: DGTR_BLESS=1 remakes it");
    assert_eq!(fs::read_dir(&spirv).unwrap().count(), sources.len() + 1, "a SPIR-V file without a source");
    if compiler.as_deref() != Some(made_by) {
        return println!("bytes not compared: they were made by {made_by}");
    }
    let folder = tempfile::tempdir().unwrap();
    for source in &sources {
        let remade = folder.path().join("remade.spv");
        compile(source, &remade);
        let stored = stored(source);
        assert!(fs::read(&stored).unwrap() == fs::read(&remade).unwrap(), "{} is stale", stored.display());
    }
}
