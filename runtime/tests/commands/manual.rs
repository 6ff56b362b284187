//! Manual pages and completions: what the command line defines, and in the onboard package nothing that does not fly.

use super::dgtr;

#[test]
fn every_command_has_a_page_and_the_onboard_manual_leaves_out_what_does_not_fly() {
    let dir = tempfile::tempdir().unwrap();
    let written = |name: &str, more: &[&str]| {
        let out = dir.path().join(name);
        let output = dgtr(&[&["manual", "--out", out.to_str().unwrap()], more].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        out
    };
    let (all, onboard) = (written("all", &[]), written("onboard", &["--onboard"]));
    for page in ["dgtr.1", "dgtr-fly.1", "dgtr-serve.1", "dgtr-plan.1", "dgtr.bash", "_dgtr", "dgtr.fish"] {
        assert!(all.join(page).is_file() && onboard.join(page).is_file(), "{page}");
    }
    for command in ["demo", "sim", "replay"] {
        let page = format!("dgtr-{command}.1");
        assert!(all.join(&page).is_file() && !onboard.join(&page).exists(), "{page}");
    }
    let read = |path: std::path::PathBuf| std::fs::read_to_string(path).unwrap();
    assert!(read(all.join("dgtr.bash")).contains("demo") && !read(onboard.join("dgtr.bash")).contains("demo"));
    let pages = std::fs::read_dir(&all).unwrap().flatten().map(|e| e.file_name().to_string_lossy().into_owned());
    // Neither this command, which is for who makes packages, nor `help`.
    assert!(!pages.into_iter().any(|page| page.contains("manual") || page.contains("help")));
    let fly = read(all.join("dgtr-fly.1"));
    assert!(fly.contains("\\-\\-mission") && read(all.join("dgtr.1")).contains("Exit codes"), "{fly}");
}
