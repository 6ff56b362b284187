//! Surveyed points that measure a finished model: what `train` says of them, and where.

use std::path::Path;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DVec2, DVec3};
use image::{Rgb, RgbImage};
use sim::photographer::to_jpeg;
use survey::card::write::Tags;

use super::{dgtr, has_device};

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 500.0 };
const SIZE: DVec2 = DVec2::new(480.0, 360.0);
/// Height of the camera above the plane, metres.
const ABOVE: f64 = 30.0;
/// Focal length as EXIF has it, millimetres of a film picture whose diagonal is 43.27 mm.
const FOCAL_MM: u16 = 35;

fn focal_px() -> f64 {
    f64::from(FOCAL_MM) * SIZE.length() / 43.266_615
}

/// Paint of a plane at height nothing, east and north in metres.
fn paint(e: f64, n: f64) -> Rgb<u8> {
    let wave = |a: f64, b: f64| ((e * a).sin() * (n * b).cos() * 60.0 + 120.0) as u8;
    Rgb([wave(0.9, 1.3), wave(1.7, 0.6), wave(0.4, 2.1)])
}

/// Twelve pictures straight down with exact positions and angles; and points of the plane marked in all that show them, by name, place
/// and by how much the survey has them too far east.
fn card(folder: &Path, points: &[(&str, DVec2, f64)]) {
    let frame = EnuFrame::new(ORIGIN);
    let mut list = String::from("EPSG:4326\n");
    std::fs::create_dir_all(folder).unwrap();
    for i in 0..12u32 {
        let at = DVec2::new(f64::from(i % 4) * 6.0, f64::from(i / 4) * 6.0);
        let name = format!("DJI_{i:04}.JPG");
        let image = RgbImage::from_fn(SIZE.x as u32, SIZE.y as u32, |x, y| {
            let off = (DVec2::new(x.into(), y.into()) + 0.5 - SIZE / 2.0) * ABOVE / focal_px();
            paint(at.x + off.x, at.y - off.y)
        });
        let position = frame.to_geodetic(at.extend(ABOVE));
        let tags = Tags {
            camera: Some(("DJI".into(), "test".into())),
            time_ns: Some(1_714_564_800_000_000_000 + u64::from(i) * 2_000_000_000),
            position: Some(position),
            focal_35mm: Some(FOCAL_MM),
            ..Tags::default()
        };
        let jpeg = tags.with_dji([0.0, -90.0, 0.0], ABOVE).into_jpeg(&to_jpeg(&image).unwrap()).unwrap();
        std::fs::write(folder.join(&name), jpeg).unwrap();
        for (point, place, too_far_east) in points {
            let off = (*place - at) * focal_px() / ABOVE;
            let pixel = SIZE / 2.0 + DVec2::new(off.x, -off.y);
            if pixel.cmpgt(DVec2::ZERO).all() && pixel.cmplt(SIZE).all() {
                let said = frame.to_geodetic(DVec3::new(place.x + too_far_east, place.y, 0.0));
                list += &format!(
                    "{:.9} {:.9} {:.3} {:.2} {:.2} {name} {point} 0.01 0.02\n",
                    said.lon_deg, said.lat_deg, said.alt_m, pixel.x, pixel.y
                );
            }
        }
    }
    std::fs::write(folder.join("gcp_list.txt"), list).unwrap();
}

#[test]
fn points_named_chk_measure_the_model_in_figures_a_table_and_a_page() {
    if !has_device() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let points = [
        ("g1", DVec2::new(4.0, 4.0), 0.0),
        ("CHK-1", DVec2::new(9.0, 6.0), 0.0),
        ("chk-VVA-2", DVec2::new(14.0, 8.0), 0.0),
        ("CHK-3", DVec2::new(12.0, 3.0), 2.0),
    ];
    card(&at("card"), &points);
    let (set, out) = (at("card").to_string_lossy().into_owned(), at("out").to_string_lossy().into_owned());
    let few = ["--max-gaussians", "4000", "--budget-mib", "128", "--steps", "60", "--scale", "0.5", "--no-eval"];
    let done = dgtr(&[&["train", &set, "--out", &out, "--no-refine"], &few[..]].concat());
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{said}");
    assert!(said.contains("asks for 30 check points") && !said.contains("Tested to meet"), "{said}");
    let table = std::fs::read_to_string(at("out/accuracy.csv")).unwrap();
    let row = |name: &str| -> Vec<String> {
        let line = table.lines().find(|l| l.starts_with(name)).unwrap_or_else(|| panic!("{name}: {table}{said}"));
        line.split(',').map(str::to_owned).collect()
    };
    let number = |name: &str, column: usize| row(name)[column].parse::<f64>().unwrap();
    assert_eq!((row("g1")[1].as_str(), row("CHK-1")[1].as_str()), ("ground control", "check points"));
    assert_eq!((row("chk-VVA-2")[10].as_str(), row("CHK-1")[9].as_str()), ("yes", "yes"));
    assert!(number("CHK-1", 2) >= 4.0 && number("CHK-1", 6) < 0.3, "{table}");
    assert!((number("CHK-3", 3) + 2.0).abs() < 0.3 && number("CHK-3", 4).abs() < 0.3, "{table}");
    let run = job::run_json::RunReport::read(&at("out")).unwrap();
    let accuracy = &run.more["accuracy"];
    assert_eq!((accuracy["points"].as_u64(), accuracy["vegetated"].as_u64()), (Some(3), Some(1)), "{accuracy}");
    // Of three points one is two metres off.
    let horizontal = accuracy["horizontal_m"].as_f64().unwrap();
    assert!((horizontal - 2.0 / 3f64.sqrt()).abs() < 0.2, "{accuracy}");
    assert_eq!(run.more["ground_control"]["points"], 1);
    assert!(said.contains("no surveyed point held them"), "{said}");
    // Continued, it says what it said.
    let again = dgtr(&[&["train", &set, "--out", &out, "--no-refine"], &few[..]].concat());
    assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
    assert_eq!(std::fs::read_to_string(at("out/accuracy.csv")).unwrap(), table);
    let page = std::fs::read_to_string(at("out/accuracy.html")).unwrap();
    assert!(page.contains("CHK-3 in DJI_00") && page.contains("photograph"), "marks are shown beside the photograph");
}

#[test]
fn a_list_that_is_named_twice_counts_once_and_what_checks_holds_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let points = [("CHK-1", DVec2::new(9.0, 6.0), 0.0), ("p2", DVec2::new(12.0, 3.0), 0.0)];
    card(&folder.path().join("card"), &points);
    let list = folder.path().join("card/gcp_list.txt");
    let other = folder.path().join("other.txt");
    std::fs::copy(&list, &other).unwrap();
    let read = |control: Option<&Path>, check: Option<&Path>| {
        let options = survey::card::CardOptions {
            control: control.map(Path::to_owned),
            check: check.map(Path::to_owned),
            ..Default::default()
        };
        let card = survey::card::Card::open(&[folder.path().join("card")], &options).unwrap();
        let names = |of: &[survey::card::control::SurveyedPoint]| of.iter().map(|p| p.name.clone()).collect::<Vec<_>>();
        (names(&card.control), names(&card.check), [card.notes, card.read].concat().join("\n"))
    };
    let (control, check, said) = read(None, None);
    assert_eq!((control, check), (vec!["p2".to_owned()], vec!["CHK-1".to_owned()]));
    assert!(said.contains("1 surveyed points are named CHK"), "{said}");
    let (control, check, said) = read(Some(&list), None);
    assert!((control.len(), check.len()) == (1, 1) && !said.contains("more than one list"), "{said}");
    let (control, check, said) = read(Some(&other), None);
    assert!(
        (control.len(), check.len()) == (1, 1) && said.contains("2 surveyed points are in more than one"),
        "{said}"
    );
    let (control, check, said) = read(None, Some(&other));
    assert!((control.len(), check.len()) == (0, 2) && said.contains("ground control, too"), "{said}");
}
