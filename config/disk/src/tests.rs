#![allow(clippy::unwrap_used)]

use std::sync::atomic::AtomicU64;

use super::bounded::{Bounded, bytes_below};
use super::*;

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn write(disk: &Disk, path: &Path, text: &str) -> Result<(), DiskError> {
    disk.replace_keeping(path, |out| out.write_all(text.as_bytes()))
}

#[test]
fn two_generations_are_kept_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("deep/model.dgtr");
    for text in ["first", "second", "third"] {
        write(&Disk::default(), &path, text).unwrap();
    }
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "third");
    assert_eq!(std::fs::read_to_string(previous(&path)).unwrap(), "second");
    assert_eq!(names(&dir.path().join("deep")), ["model.dgtr", "model.previous.dgtr"]);
}

#[test]
fn generations_that_a_cut_left_as_one_file_come_apart_and_leave_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.dgtr");
    write(&Disk::default(), &path, "first").unwrap();
    // As it is between keeping the earlier one and replacing it.
    std::fs::hard_link(&path, previous(&path)).unwrap();
    write(&Disk::default(), &path, "second").unwrap();
    assert_eq!(std::fs::read_to_string(previous(&path)).unwrap(), "first");
    assert_eq!(names(dir.path()), ["model.dgtr", "model.previous.dgtr"]);
}

#[test]
fn a_failed_write_leaves_the_old_content_and_no_temporary_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("list.json");
    let limit = Arc::new(AtomicU64::new(100));
    let disk = Disk::new(Bounded::new(System, dir.path(), limit.clone()));
    write(&disk, &path, "old").unwrap();
    let e = write(&disk, &path, &"x".repeat(200)).unwrap_err();
    assert!(is_full(&e.source) && e.action == "writing", "{e}");
    assert_eq!((std::fs::read_to_string(&path).unwrap().as_str(), names(dir.path()).len()), ("old", 1));
    limit.store(1000, Ordering::Relaxed);
    write(&disk, &path, &"x".repeat(200)).unwrap();
    assert_eq!(bytes_below(dir.path()), 203);
}

/// `.dgtr-PID-N` could be put there first, as a link to whatever the program may write.
#[test]
fn a_link_in_a_temporary_files_place_is_not_written_through_and_nobody_can_foresee_its_name() {
    let dir = tempfile::tempdir().unwrap();
    let [keepsake, gone, path] = ["keepsake", "gone", "model.dgtr"].map(|name| dir.path().join(name));
    std::fs::write(&keepsake, "mine").unwrap();
    for (n, target) in [&keepsake, &gone].into_iter().enumerate() {
        let link = dir.path().join(format!(".dgtr-1-{n}"));
        std::os::unix::fs::symlink(target, &link).unwrap();
        assert_eq!(System.create(&link).unwrap_err().kind(), ErrorKind::AlreadyExists);
    }
    assert!(std::fs::read(&keepsake).unwrap() == b"mine" && !gone.exists());
    let names: Vec<String> =
        (0..1000).map(|_| temporary_beside(&path).file_name().unwrap().to_string_lossy().into_owned()).collect();
    let made_by = format!(".dgtr-{}-", std::process::id());
    let beginnings: std::collections::HashSet<&str> =
        names.iter().map(|name| &name.strip_prefix(&made_by).unwrap()[..8]).collect();
    assert!(beginnings.len() > 990, "{}", beginnings.len());
}

#[test]
fn a_damaged_file_is_set_aside_by_name_and_none_is_overwritten() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.dgtr");
    for n in 1..=3 {
        std::fs::write(&path, format!("damaged {n}")).unwrap();
        assert_eq!(Disk::default().set_aside(&path).unwrap(), dir.path().join(format!("model.damaged-{n}.dgtr")));
    }
    assert_eq!(names(dir.path()).len(), 3);
}

#[test]
fn of_two_generations_the_newest_sound_one_is_read_and_a_damaged_one_never_again() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.dgtr");
    let disk = Disk::default();
    let read = |p: &Path| match std::fs::read_to_string(p).unwrap() {
        text if text.starts_with("sound") => Ok(text),
        _ => Err(format!("{} is damaged", p.display())),
    };
    assert!(disk.newest(&path, read).unwrap().found.is_none());
    for text in ["sound 1", "sound 2", "cut"] {
        write(&disk, &path, text).unwrap();
    }
    let first = disk.newest(&path, read).unwrap();
    assert_eq!((first.found.as_deref(), first.damaged.len()), (Some("sound 2"), 1));
    let said = first.damaged[0].to_string();
    assert!(said.contains("model.dgtr is damaged; set aside as") && said.ends_with("model.damaged-1.dgtr"), "{said}");
    let again = disk.newest(&path, read).unwrap();
    assert_eq!((again.found.as_deref(), again.damaged.len()), (Some("sound 2"), 0));
    // The next write leaves both generations sound again.
    write(&disk, &path, "sound 3").unwrap();
    std::fs::write(&path, "cut").unwrap();
    std::fs::write(previous(&path), "cut").unwrap();
    let neither = disk.newest(&path, read).unwrap();
    assert!(neither.found.is_none() && neither.damaged.len() == 2);
    assert_eq!(names(dir.path()).len(), 3);
}

#[test]
fn lines_go_on_behind_the_last_whole_one() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out/geotags.csv");
    for (found, whole) in [("a\nb\ntorn", "a\nb\n"), ("a\nb\0\0\0\n", "a\n"), ("torn", ""), ("a\n", "a\n")] {
        std::fs::create_dir_all(dir.path().join("out")).unwrap();
        std::fs::write(&path, found).unwrap();
        Disk::default().append_lines(&path).unwrap().write(b"next\n").unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), format!("{whole}next\n"));
    }
}

#[test]
fn lines_for_which_a_disk_has_no_room_are_not_there_in_part_and_the_next_ones_follow_the_last_whole_one() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().canonicalize().unwrap();
    let path = root.join("geotags.csv");
    let disk = Disk::new(Bounded::new(System, &root, Arc::new(AtomicU64::new(14))));
    let mut lines = disk.append_lines(&path).unwrap();
    let written = |lines: &mut Lines, line: &str| lines.write(line.as_bytes()).map_err(|e| e.kind());
    let found = || std::fs::read_to_string(&path).unwrap();
    assert_eq!(written(&mut lines, "first\n"), Ok(()));
    for _ in 0..3 {
        assert_eq!(written(&mut lines, "much longer\n"), Err(ErrorKind::QuotaExceeded));
        assert_eq!(found(), "first\n");
    }
    assert_eq!(written(&mut lines, "last\n"), Ok(()));
    assert_eq!(found(), "first\nlast\n");
    // One that another process tore is mended without room for a copy.
    std::fs::write(&path, "first\nlast\ntorn....................").unwrap();
    drop(disk.append_lines(&path).unwrap());
    assert_eq!(found(), "first\nlast\n");
}

#[test]
fn lines_are_not_written_behind_a_link() {
    let dir = tempfile::tempdir().unwrap();
    let (path, theirs) = (dir.path().join("geotags.csv"), dir.path().join("theirs"));
    std::fs::write(&theirs, "their word, torn").unwrap();
    std::os::unix::fs::symlink(&theirs, &path).unwrap();
    assert!(Disk::default().append_lines(&path).is_err());
    assert_eq!(std::fs::read_to_string(&theirs).unwrap(), "their word, torn");
}

#[test]
fn what_a_kill_left_is_swept_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    for name in [".dgtr-77-3", ".dgtr-1-0", "model.dgtr", ".profile"] {
        std::fs::write(dir.path().join(name), name).unwrap();
    }
    assert_eq!(Disk::default().sweep(dir.path()), 2);
    assert_eq!(names(dir.path()), [".profile", "model.dgtr"]);
    assert_eq!(Disk::default().sweep(&dir.path().join("none")), 0);
}

#[test]
fn beside_other_processes_only_what_ended_ones_left_is_swept() {
    let dir = tempfile::tempdir().unwrap();
    let (running, ended) = (format!(".dgtr-{}-3", std::process::id()), ".dgtr-4294967295-0");
    for name in [&running, ended, ".dgtr-x", "a1.flight"] {
        std::fs::write(dir.path().join(name), name).unwrap();
    }
    assert_eq!(Disk::default().sweep_abandoned(dir.path()), 1);
    assert_eq!(names(dir.path()), [running.as_str(), ".dgtr-x", "a1.flight"]);
}

#[test]
fn what_is_reserved_for_a_file_without_a_name_is_missing_to_the_others_and_never_more_than_there_is() {
    let dir = tempfile::tempdir().unwrap();
    let disk = Disk::new(Bounded::new(System, dir.path(), Arc::new(AtomicU64::new(1000))));
    let write = |name: &str, bytes: usize| disk.replace(&dir.path().join(name), |out| out.write_all(&vec![7; bytes]));
    write("a", 300).unwrap();
    assert_eq!(disk.reserve(701).unwrap_err().kind(), io::ErrorKind::QuotaExceeded);
    disk.reserve(600).unwrap();
    write("b", 100).unwrap();
    assert!(write("c", 1).is_err());
    // Where there is no bound, the file system alone says no.
    assert!(Disk::default().reserve(u64::MAX).is_ok());
}
