//! Promises on cards of real pictures that say nothing of their places: what belongs together is found, what does not is named and left out.
//! Needs the reference data (`DGTR_DATA`); says so and passes without.
#![allow(clippy::unwrap_used)] // a test may

use std::path::{Path, PathBuf};

use config::refine::RefineSettings;
use models::refine::{RefineError, Refiner, Untied};
use needs::shared;
use survey::card::CardOptions;
use survey::dataset::Dataset;
use survey::settling::{Needs, Settlement, settle};

/// The first so many pictures of a card, by name.
fn pictures(card: &Path, count: usize) -> Vec<PathBuf> {
    let mut all: Vec<PathBuf> =
        std::fs::read_dir(card.join("DCIM")).unwrap().map(|entry| entry.unwrap().path()).collect();
    all.sort();
    all.truncate(count);
    all
}

fn settled(set: &Dataset) -> Option<Settlement> {
    let notes = set.card.clone().unwrap();
    let found = settle(
        set,
        &notes,
        &RefineSettings::default(),
        &mut Needs::<RefineError> {
            open: &mut |settings| Refiner::open(settings),
            control: &|_| Vec::new(),
            taken: &mut |_, _| {},
            cancelled: &|| false,
            fits: &|_| true,
        },
    );
    match found {
        Ok(found) => found,
        Err(e) => {
            needs::missing(needs::Need::OnnxRuntime, e);
            None
        }
    }
}

#[test]
fn a_card_of_two_places_is_the_larger_one_and_every_picture_of_the_other_is_named_and_left_out() {
    let (Some(one), Some(other)) = (shared("data/sceaux"), shared("data/banana")) else { return };
    let card = tempfile::tempdir().unwrap();
    let (mut wanted, mut strangers) = (Vec::new(), Vec::new());
    for (from, count, names) in [(&one, 7, &mut wanted), (&other, 3, &mut strangers)] {
        for path in pictures(from, count) {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            std::fs::copy(&path, card.path().join(&name)).unwrap();
            names.push(name);
        }
    }
    let set = Dataset::open_card(&[card.path().to_owned()], &CardOptions::default()).unwrap();
    let Some(found) = settled(&set) else { return };
    let mut tied: Vec<&String> = found.settled.keys().collect();
    tied.sort();
    assert_eq!(tied, wanted.iter().collect::<Vec<_>>());
    let mut untied: Vec<&String> = found.untied.iter().map(|u| &u.0).collect();
    untied.sort();
    assert_eq!(untied, strangers.iter().collect::<Vec<_>>());
    assert!(
        found.untied.iter().all(|u| matches!(u.1, Untied::Apart | Untied::Alone | Untied::Weak)),
        "{:?}",
        found.untied
    );
    assert!(found.floats && found.solved.reprojection_median_px < 0.4);
}
