//! Promises of the store, in a folder, and in a bucket where `DGTR_S3_TEST` names one (`s3://BUCKET/PREFIX`, with the AWS variables).

use super::*;

fn stores(dir: &Path) -> Vec<Store> {
    let mut all = vec![Store::folder(&dir.join("store"))];
    match std::env::var("DGTR_S3_TEST") {
        Ok(place) => all.push(Store::open(&place).expect("a bucket")),
        Err(_) => needs::missing(needs::Need::Bucket, "DGTR_S3_TEST names no bucket"),
    }
    all
}

#[test]
fn what_was_put_is_had_back_in_part_and_whole_and_is_gone_when_removed() {
    let dir = tempfile::tempdir().expect("temp dir");
    for store in stores(dir.path()) {
        assert_eq!(store.size("cells/a").expect("asked"), None);
        assert!(matches!(store.range("cells/a", 0, 1), Err(StoreError::Missing(_))));
        for content in [&b"first"[..], &b"the second one"[..]] {
            store.put("cells/a", &|out| out.write_all(content)).expect("put");
            assert_eq!(store.size("cells/a").expect("asked"), Some(content.len() as u64));
            assert_eq!(store.range("cells/a", 0, content.len() as u64).expect("read"), content);
        }
        assert_eq!(store.range("cells/a", 4, 6).expect("read"), b"second");
        assert_eq!(store.range("cells/a", 4, 0).expect("read"), b"");
        assert!(store.range("cells/a", 4, 60).is_err(), "it ends before");
        store.remove("cells/a").expect("removed");
        store.remove("cells/a").expect("removed already");
        assert_eq!(store.size("cells/a").expect("asked"), None);
    }
}

#[test]
fn a_write_that_fails_leaves_what_was_there() {
    let dir = tempfile::tempdir().expect("temp dir");
    for store in stores(dir.path()) {
        store.put("plan", &|out| out.write_all(b"old")).expect("put");
        let cut = |out: &mut dyn Write| {
            out.write_all(b"ne")?;
            Err(io::Error::other("cut off"))
        };
        assert!(store.put("plan", &cut).is_err_and(|e| e.to_string().contains("cut off")));
        assert_eq!(store.range("plan", 0, 3).expect("read"), b"old");
        store.remove("plan").expect("removed");
    }
}

#[test]
fn nothing_is_removed_behind_a_link_or_of_a_name_that_no_worker_has() {
    let dir = tempfile::tempdir().expect("a folder");
    let [store, away] = ["store", "away"].map(|name| dir.path().join(name));
    let (worker, cell) = ("7".repeat(16), "c".repeat(64));
    for folder in [store.clone(), away.join(&worker)] {
        std::fs::create_dir_all(folder).expect("made");
    }
    std::fs::write(away.join(&cell), b"mine").expect("written");
    let swept = Store::folder(&store);
    for name in ["cells", "writing"] {
        std::os::unix::fs::symlink(&away, store.join(name)).expect("linked");
    }
    swept.keep_only("cells", &|_| false);
    assert!(away.join(&cell).exists() && away.join(&worker).exists());
    // In folders of its own it removes what a worker left and cells that are not kept, and nothing else.
    for (folder, ours) in [("cells", &cell), ("writing", &worker)] {
        std::fs::remove_file(store.join(folder)).expect("removed");
        std::fs::create_dir_all(store.join(folder).join("photos")).expect("made");
        let place = store.join(folder).join(ours);
        if folder == "writing" { std::fs::create_dir(place) } else { std::fs::write(place, b"") }.expect("made");
    }
    std::fs::write(store.join("cells/notes"), b"").expect("written");
    swept.keep_only("cells", &|_| false);
    for (folder, theirs, ours) in [("cells", "notes", &cell), ("writing", "photos", &worker)] {
        assert!(store.join(folder).join(theirs).exists() && !store.join(folder).join(ours).exists(), "{folder}");
    }
}

#[test]
fn a_place_that_is_none_is_named() {
    for place in ["s3://", "s3:///prefix"] {
        let refused = Store::open(place).err().expect("refused");
        assert_eq!(refused.kind(), ErrorKind::Input);
        assert!(refused.to_string().contains(place), "{refused}");
    }
}
