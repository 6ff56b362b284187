use super::*;
use crate::Source;
use crate::keys::Identity;
use crate::offer::{OfferedModel, Order};
use crate::power_cut::states::{State, each};
use crate::power_cut::{Done, Recorder};

fn settings() -> UploadSettings {
    UploadSettings { chunk_kib: 16, max_model_mib: 1, ..UploadSettings::default() }
}

fn admission() -> Admission {
    let (mission, aircraft) = ("m".into(), vec!["a1".into()]);
    Admission {
        mission,
        aircraft,
        identity: Identity::unsigned(),
        check: Box::new(|_, _| Ok(())),
        memory: Default::default(),
    }
}

/// A checkpoint and the final model of one aircraft, which have chunks in common.
fn models(folder: &Path) -> Vec<OfferedModel> {
    let model = |counter: u64, finished| {
        let path = folder.join(format!("{counter}.dgtr"));
        let mut bytes = vec![7; 20_000];
        blake3::Hasher::new_keyed(&[counter as u8; 32]).finalize_xof().fill(&mut bytes[16_384..]);
        std::fs::write(&path, bytes).expect("written");
        OfferedModel::open(&path, &settings(), &Source::unsigned("m", "a1"), Order { flight: 1, counter }, finished)
            .expect("a model")
    };
    vec![model(1, false), model(2, true)]
}

/// Receives what is missing of `model`.
fn receive(store: &mut Store, model: &OfferedModel) -> Result<(), StoreError> {
    for index in store.missing(&model.offer) {
        store.put(&model.offer, index, &model.chunk(index).expect("held"))?;
    }
    store.assemble(&model.offer, &admission())
}

/// Opens what the power cut left and receives the rest; what went wrong.
fn continues_from(state: &State, promised: &[u64], recorded: &Path, models: &[OfferedModel]) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
    state.lay_out(recorded, folder.path()).map_err(|e| e.to_string())?;
    let mut store = Store::open(&Disk::default(), folder.path(), &settings(), &admission());
    let here = store.complete().map_or(0, |offer| offer.order.counter);
    if here < promised.last().copied().unwrap_or(0) {
        return Err(format!("model {promised:?} was complete and is lost: {here} is there"));
    }
    for model in models.iter().filter(|m| m.offer.order.counter > here) {
        // A chunk that was torn is found out when the model is put together, removed, and fetched again.
        let mut tries = 0;
        while let Err(e) = receive(&mut store, model) {
            tries += 1;
            if tries > 3 {
                return Err(format!("does not go on: {e}"));
            }
        }
    }
    let whole = store.hash_of_model() == models.last().map(|m| m.offer.model);
    let left =
        |dir: &Path| std::fs::read_dir(dir).into_iter().flatten().flatten().map(|e| e.file_name()).collect::<Vec<_>>();
    let (names, chunks) = (left(folder.path()), left(&folder.path().join("chunk")));
    let tidy = names.iter().all(|n| n.to_str().is_some_and(|n| !n.starts_with(".dgtr-"))) && chunks.is_empty();
    if whole && tidy { Ok(()) } else { Err(format!("whole: {whole}, left {names:?} {chunks:?}")) }
}

#[test]
fn a_power_cut_after_any_operation_of_a_reception_loses_no_model_that_was_complete() {
    let folder = tempfile::tempdir().expect("folder");
    let (models, dir) = (models(folder.path()), folder.path().join("received/a1"));
    let recorder = Recorder::new(false);
    let disk = Disk::new(recorder.clone());
    disk.make_folders(&dir).expect("made");
    let mut store = Store::open(&disk, &dir, &settings(), &admission());
    for model in &models {
        receive(&mut store, model).expect("received");
        recorder.promise(model.offer.order.counter);
    }
    // The same bytes once more, as final again: only the note is written.
    store.note(&models[1].offer).expect("noted");
    let done: Vec<Done<u64>> = recorder.take();
    let mut wrong = Vec::new();
    let states = each(&done, |state, promised| wrong.extend(continues_from(&state, promised, &dir, &models).err()));
    println!("{} operations, {states} states after a power cut, {} wrong", done.len(), wrong.len());
    assert!(wrong.is_empty(), "{} of {states}: {:#?}", wrong.len(), &wrong[..wrong.len().min(5)]);
    assert!(states >= 100, "{states} states");
}

#[test]
fn nothing_is_removed_behind_a_link_in_the_place_of_the_chunks() {
    let folder = tempfile::tempdir().expect("a folder");
    let [elsewhere, own] = ["elsewhere", "own"].map(|name| folder.path().join(name));
    let name = "a".repeat(64);
    for made in [&elsewhere, &own] {
        std::fs::create_dir(made).expect("made");
    }
    std::fs::write(elsewhere.join(&name), b"another's").expect("written");
    std::os::unix::fs::symlink(&elsewhere, own.join("chunk")).expect("linked");
    Store::open(&Disk::default(), &own, &settings(), &admission()).keep_only(None);
    assert!(elsewhere.join(&name).is_file());
}
