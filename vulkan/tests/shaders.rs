//! The checked-in SPIR-V belongs to the GLSL beside it: `spirv/sources.txt` holds a hash of every source it was made
//! from, and where the same `glslangValidator` is installed the bytes are compared too. `DGTR_BLESS=1` remakes both.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
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

/// Compiles all kernels into `folder`.
fn compile(folder: &Path) {
    let done = Command::new(shaders().join("compile.sh")).arg(folder).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

/// The compiled kernels of a folder by name.
fn compiled(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let files = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let kernels = files.filter(|p| p.extension().is_some_and(|e| e == "spv"));
    kernels.map(|p| (p.file_name().unwrap().display().to_string(), fs::read(&p).unwrap())).collect()
}

#[test]
fn checked_in_spirv_is_what_the_sources_compile_to() {
    let (bless, compiler) = (std::env::var_os("DGTR_BLESS").is_some(), compiler());
    let spirv = shaders().join("spirv");
    let list = spirv.join("sources.txt");
    let mut sources: Vec<PathBuf> = fs::read_dir(shaders()).unwrap().map(|e| e.unwrap().path()).collect();
    sources.retain(|p| p.extension().is_some_and(|e| e == "comp"));
    sources.sort();
    let fresh = sources.iter().fold(String::new(), |mut all, s| {
        writeln!(all, "{:016x} {}", hash(&expanded(s)), s.file_name().unwrap().display()).unwrap();
        all
    });
    if bless {
        compile(&spirv);
        fs::write(&list, compiler.clone().unwrap() + "\n" + &fresh).unwrap();
    }
    let text = fs::read_to_string(&list).unwrap();
    let (made_by, hashes) = text.split_once('\n').unwrap();
    assert!(hashes == fresh, "the SPIR-V is older than its sources: DGTR_BLESS=1 remakes it");
    if compiler.as_deref() != Some(made_by) {
        return println!("bytes not compared: they were made by {made_by}");
    }
    let folder = tempfile::tempdir().unwrap();
    compile(folder.path());
    let (stored, remade) = (compiled(&spirv), compiled(folder.path()));
    assert!(stored.keys().eq(remade.keys()), "a SPIR-V file without a source, or the other way round");
    for (name, bytes) in &stored {
        assert!(remade[name] == *bytes, "{name} is stale");
    }
}
