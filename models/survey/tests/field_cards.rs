//! Cards and tables as people have them, each with one fault: the right result, a line that names the fault, or a refusal. They lie in
//! the reference data; where that is not there, the tests fail unless DGTR_SKIP names `cases`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::{Path, PathBuf};

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;
use survey::card::{Card, CardError, CardOptions, Series, control, geotags, log};

fn field(name: &str) -> Option<PathBuf> {
    needs::shared(&format!("field/cards/{name}"))
}

fn open(folder: &Path) -> Result<Card, CardError> {
    Card::open(&[folder.to_owned()], &CardOptions::default())
}

fn heights(card: &Card) -> Vec<f64> {
    let origin = card.origin.expect("a place").alt_m;
    card.pictures.iter().map(|p| p.prior.pose.center.z + origin).collect()
}

/// One line that holds all of `parts`.
fn assert_said(card: &Card, parts: &[&str]) {
    let found: Vec<_> = card.notes.iter().filter(|n| parts.iter().all(|p| n.contains(p))).collect();
    assert!(found.len() == 1 && !found[0].contains('\n'), "{parts:?} in {:#?}", card.notes);
}

#[test]
fn equal_positions_are_none() {
    let Some(folder) = field("samegps") else { return };
    let card = open(&folder).unwrap();
    assert!(card.origin.is_none() && card.pictures.len() == 12);
    assert_said(&card, &["12 pictures", "one position"]);
}

#[test]
fn an_altitude_below_zero_in_bits_without_a_sign_is_taken_as_that() {
    let Some(folder) = field("altunderflow") else { return };
    let card = open(&folder).unwrap();
    let heights = heights(&card);
    assert!(heights.iter().all(|z| (-1000.0..1000.0).contains(z)), "{heights:?}");
    assert_said(&card, &["without a sign"]);
}

#[test]
fn an_altitude_of_zero_gives_way_to_one_in_xmp() {
    let Some(folder) = field("alt0_xmpabs") else { return };
    let card = open(&folder).unwrap();
    let heights = heights(&card);
    assert!(heights.iter().all(|z| (190.0..210.0).contains(z)), "{heights:?}");
}

#[test]
fn pictures_without_a_position_are_counted_and_believed_anywhere_on_the_card() {
    let Some(folder) = field("half_gps") else { return };
    let card = open(&folder).unwrap();
    let unknown = card.pictures.iter().filter(|p| p.prior.sigma.position_m[0] >= 100.0).count();
    assert!(unknown >= 4, "{unknown}");
    assert_said(&card, &["no GPS position", "nor have those beside it"]);
}

#[test]
fn surveyed_points_in_another_zone_or_hemisphere_are_refused_and_those_without_heights_hold_the_plane() {
    let (Some(card), Some(lists)) = (field("alt0_xmpabs"), field("gcp")) else { return };
    let with = |list: &str| {
        let options = CardOptions { control: Some(lists.join(list)), ..CardOptions::default() };
        Card::open(std::slice::from_ref(&card), &options)
    };
    for good in ["good_utm15.txt", "good_deg.txt"] {
        let control = with(good).unwrap().control;
        assert!(!control.is_empty() && control.iter().all(|p| p.sigma_m[1] < 1.0), "{good}");
    }
    for bad in ["wrongzone16.txt", "south.txt"] {
        let error = with(bad).unwrap_err().to_string();
        assert!(error.contains(bad) && error.contains("km from where") && !error.contains('\n'), "{error}");
    }
    for (flat, why) in [("alt0.txt", "are all 0"), ("feetz.txt", "are they in feet?")] {
        let card = with(flat).unwrap();
        assert!(!card.control.is_empty() && card.control.iter().all(|p| p.sigma_m[1] >= 100.0), "{flat}");
        assert_said(&card, &[flat, why, "only their places"]);
    }
}

#[test]
fn lists_of_surveyed_points_are_read_however_they_name_their_reference_system() {
    let Some(lists) = field("gcp") else { return };
    // What the reader cannot know it refuses: no reference system, one of a country's own name, coordinates off the earth.
    let refused = ["noheader.txt", "ochota_PUWG1992.txt", "swapped.txt", "epsg_vertical_only.txt"];
    for entry in std::fs::read_dir(&lists).unwrap().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        match control::read(&entry.path()) {
            Ok(points) => {
                assert!(!refused.contains(&name.as_str()), "{name} is taken");
                assert!(!points.is_empty() && points.iter().all(|p| p.position.is_valid()), "{name}");
                let marked = points.iter().flat_map(|p| &p.marks).all(|(picture, _)| picture.contains("dji"));
                assert!(marked, "{name}: {points:?}");
            }
            Err(e) => {
                assert!(refused.contains(&name.as_str()), "{name}: {e}");
                assert!(!e.to_string().contains('\n'), "{e}");
            }
        }
    }
}

#[test]
fn a_pitch_of_minus_ninety_in_geo_txt_looks_down() {
    let Some(folder) = field("geo_pitch90") else { return };
    let card = open(&folder).unwrap();
    assert!(card.pictures.iter().all(|p| (p.prior.pose.rotation * DVec3::Z).z < -0.9));
}

#[test]
fn tags_behind_pointers_of_type_13_are_read() {
    let Some(folder) = field("type13_ifd") else { return };
    let card = open(&folder).unwrap();
    let origin = card.origin.expect("a place");
    assert!((origin.lat_deg - 50.985).abs() < 0.01 && (origin.lon_deg - 21.425).abs() < 0.01, "{origin:?}");
}

#[test]
fn bytes_behind_a_jpegs_end_are_no_fault() {
    let Some(folder) = field("trailer") else { return };
    assert_eq!(open(&folder).unwrap().pictures.len(), 3);
}

#[test]
fn a_card_whose_own_list_of_points_is_in_another_zone_is_refused() {
    let Some(folder) = field("gcp_wrongzone") else { return };
    let error = open(&folder).unwrap_err().to_string();
    assert!(error.contains("gcp_list.txt") && error.contains("km from where") && !error.contains('\n'), "{error}");
}

#[test]
fn pictures_that_are_cut_off_are_named_and_left_out() {
    let Some(folder) = field("noeoi") else { return };
    match open(&folder) {
        Ok(card) => assert_said(&card, &["cut off"]),
        Err(e) => assert!(e.to_string().contains("cut off") && !e.to_string().contains('\n'), "{e}"),
    }
}

#[test]
fn of_two_models_the_larger_is_the_data_set() {
    let Some(folder) = field("twomodels") else { return };
    let set = survey::dataset::Dataset::open(&folder).unwrap();
    let model = models::formats::colmap::Model::find(&folder).unwrap().unwrap();
    let said = model.said().unwrap();
    assert_eq!(set.frames.len(), model.images().unwrap().len());
    assert!(said.contains("the largest") && !said.contains('\n'), "{said}");
    for other in ["sparse/0", "sparse/1"].map(|name| folder.join(name)) {
        let images = models::formats::colmap::read_images(&other.join("images.bin")).map_or(0, |images| images.len());
        assert!(images <= set.frames.len(), "{}", other.display());
    }
}

#[test]
fn a_film_or_phone_pictures_alone_are_named_with_the_way_to_use_them() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("DJI_0001.MP4"), b"ftyp").unwrap();
    std::fs::write(dir.path().join("IMG_1.HEIC"), b"ftyp").unwrap();
    let error = survey::dataset::Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(error.contains("ffmpeg") && error.contains("magick") && !error.contains('\n'), "{error}");
}

/// A case among the logs and tables of the field; `None` (or a failing test) where they are not there.
fn logged(name: &str) -> Option<std::path::PathBuf> {
    needs::shared(&format!("field/mavlink/{name}"))
}

/// Where each picture of the card was taken: name, latitude, longitude, altitude.
fn truth() -> Option<Vec<(String, Geodetic)>> {
    let text = std::fs::read_to_string(logged("truth.json")?).unwrap();
    let rows: Vec<serde_json::Value> = serde_json::from_str(&text).unwrap();
    let place = |row: &serde_json::Value| {
        let of = |name: &str| row[name].as_f64().unwrap();
        Geodetic { lat_deg: of("lat"), lon_deg: of("lon"), alt_m: of("alt") }
    };
    Some(rows.iter().map(|row| (row["name"].as_str().unwrap().to_lowercase(), place(row))).collect())
}

fn apart_m(a: Geodetic, b: Geodetic) -> f64 {
    EnuFrame::new(a).to_enu(b).length()
}

#[test]
fn tables_of_positions_in_the_forms_of_other_programs_place_every_picture() {
    let (Some(folder), Some(truth)) = (logged("inputs/geo"), truth()) else { return };
    let mut read = 0;
    for entry in std::fs::read_dir(&folder).unwrap().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        match geotags::read(&entry.path()) {
            Ok(found) => {
                assert_eq!(found.tags.len(), truth.len(), "{name}");
                for ((picture, tag), (of, place)) in found.tags.iter().zip(&truth) {
                    assert!(
                        picture.ends_with(of) && apart_m(tag.fix.position, *place) < 0.05,
                        "{name}: {picture} {tag:?}"
                    );
                }
                read += 1;
            }
            // It names no pictures.
            Err(e) => assert!(name == "suas.txt" && e.to_string().contains("no picture"), "{name}: {e}"),
        }
    }
    assert_eq!(read, 8);
}

#[test]
fn ardupilot_logs_of_every_kind_hold_the_exposures_of_the_card() {
    let Some(truth) = truth() else { return };
    for name in ["cam_ok.BIN", "cam_ok_named.log", "cam_text.log", "cam_ac32.BIN"] {
        let Some(path) = logged(&format!("inputs/{name}")) else { return };
        let series = log::read(&path).unwrap().unwrap();
        let [Series { exposures, .. }] = series.as_slice() else { panic!("{name}: {} cameras", series.len()) };
        assert_eq!(exposures.len(), truth.len(), "{name}");
        for (e, (picture, place)) in exposures.iter().zip(&truth) {
            assert!(apart_m(e.fix.position, *place) < 0.05, "{name}: {picture} {e:?}");
        }
    }
    let Some(two) = logged("inputs/cam_two.BIN") else { return };
    let counts: Vec<_> =
        log::read(&two).unwrap().unwrap().iter().map(|s| (s.source.camera, s.exposures.len())).collect();
    assert!(counts.len() == 2 && counts[0] == (Some(0), 18), "{counts:?}");
}
