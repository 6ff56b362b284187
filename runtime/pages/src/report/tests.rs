//! Promises of the page. With `DGTR_REPORT_SAMPLE=FILE` a sample page is left there to be looked at.

use super::*;

fn stripes(w: u32, h: u32, phase: u32) -> RgbImage {
    RgbImage::from_fn(w, h, |x, y| image::Rgb([(x + phase) as u8, (y * 2) as u8, ((x ^ y) & 0x7f) as u8]))
}

fn sample() -> ReportData {
    let square = |x: f64| vec![[x, 0.0], [x + 70.0, 0.0], [x + 70.0, 160.0], [x, 160.0]];
    let cameras =
        |x: f64| (0..25).map(|i| [x + f64::from(i % 5) * 14.0 + 7.0, f64::from(i / 5) * 30.0 + 15.0]).collect();
    let row = |name: &str, n: u64| ModelRow {
        name: name.into(),
        views: Some(25),
        gaussians: Some(n),
        steps: Some(1500),
        seconds: Some(83.4),
        psnr: Some(22.41),
        ssim: Some(0.631),
        uploaded: (name != "global").then_some(n * 60),
        pictures: (name != "global").then_some(3_400_000),
    };
    let panels =
        || ["photograph", "local model", "global model"].map(|l| (l.to_owned(), stripes(320, 240, l.len() as u32)));
    ReportData {
        title: "Mission park".into(),
        subtitle: "2 aircraft · llvmpipe · 2026-01-01".into(),
        headline: vec![
            ("held-out PSNR".into(), "22.41 dB".into()),
            ("Gaussians".into(), count(181_422)),
            ("sent instead of pictures".into(), bytes(11_000_000)),
            ("total".into(), seconds(222.0)),
        ],
        map: ["west", "east"]
            .into_iter()
            .zip([0.0, 70.0])
            .map(|(n, x)| MapRegion { name: n.into(), corners: square(x), cameras: cameras(x) })
            .collect(),
        models: vec![row("west", 92_000), row("east", 101_422), row("global", 181_422)],
        comparisons: vec![
            Comparison { title: "DJI_0001.jpg".into(), note: "22.9 dB".into(), panels: panels().to_vec() },
            Comparison { title: "DJI_0002.jpg".into(), note: "seam".into(), panels: panels()[..2].to_vec() },
        ],
        timings: vec![
            Timing { name: "initialise".into(), of: "west".into(), seconds: 12.0 },
            Timing { name: "train".into(), of: "west".into(), seconds: 83.4 },
            Timing { name: "train".into(), of: "east".into(), seconds: 61.0 },
            Timing { name: "distil".into(), of: String::new(), seconds: 14.2 },
        ],
        skipped: vec![("views without a seam, not distilled".into(), 31), ("pictures without a pose".into(), 1)],
        warnings: vec!["east's link was lost for 12 s; <3 pictures> & nothing else are missing".into()],
        aircraft: vec![],
        ground: Ground::default(),
        charts: vec![],
        tables: vec![],
        files: vec![("global model".into(), "/tmp/out/global.dgtr".into())],
    }
}

/// What is embedded under `id`.
fn embedded(html: &str, id: &str) -> serde_json::Value {
    let from = html.split_once(&format!("id=\"{id}\">")).expect(id).1;
    serde_json::from_str(from.split_once("</script>").expect("its end").0).expect("JSON")
}

#[test]
fn a_page_needs_no_network_and_what_it_shows_cannot_become_markup() {
    let mut data = sample();
    data.title = "</script><b>{foot}{head}".into();
    data.warnings.push("</script><script>alert(1)</script>".into());
    let html = data.to_html().expect("page");
    assert!(!html.contains("http:") && !html.contains("https:") && !html.contains("<b>"));
    assert!(html.contains("<h1 id=\"title\">&lt;/script&gt;&lt;b&gt;{foot}{head}</h1>"));
    assert!(html.contains("default-src 'none'"), "a report asks nobody for anything");
    // State, ground and the script itself: nothing else begins or ends one.
    assert_eq!((html.matches("<script").count(), html.matches("</script").count()), (3, 3));
    assert_eq!(html.matches("data:image/jpeg;base64,").count(), 5);
    for tag in ["div", "section", "svg", "main", "dl", "ul", "label", "fieldset"] {
        let body = html.split_once("<body>").expect("a body").1.split_once("<script").expect("a script").0;
        assert_eq!(body.matches(&format!("<{tag}")).count(), body.matches(&format!("</{tag}>")).count(), "{tag}");
    }
    if let Some(path) = std::env::var_os("DGTR_REPORT_SAMPLE") {
        sample().write(Path::new(&path)).expect("write");
    }
}

#[test]
fn every_part_of_a_report_is_in_the_state_that_the_page_draws() {
    let mut data = sample();
    data.aircraft.push(Craft { key_frames: Some(25), ..Craft::new("west", "done") });
    data.tables.push(Table { title: "Merging".into(), rows: vec![vec!["a".into()]], ..Table::default() });
    let state = embedded(&data.to_html().expect("page"), "state");
    assert_eq!(state["headline"][0], serde_json::json!(["held-out PSNR", "22.41 dB"]));
    assert_eq!(state["models"]["head"].as_array().map(Vec::len), Some(9));
    assert_eq!(state["models"]["rows"][2][0], "global");
    assert_eq!(state["models"]["rows"][0][5], "22.41");
    assert_eq!(state["comparisons"][1]["panels"].as_array().map(Vec::len), Some(2));
    assert_eq!((&state["timings"][1]["share"], &state["timings"][1]["text"]), (&1.0.into(), &"83 s".into()));
    assert_eq!(state["skipped"][0][1], "31");
    assert_eq!(state["files"][0][1], "/tmp/out/global.dgtr");
    assert!(state["warnings"][0].as_str().is_some_and(|w| w.contains("<3 pictures> & nothing")));
    assert_eq!(state["regions"][1]["cameras"].as_array().map(Vec::len), Some(25));
    assert_eq!(state["aircraft"][0]["facts"][0], serde_json::json!(["key frames", "25"]));
    assert_eq!(state["tables"][0]["title"], "Merging");
}

#[test]
fn every_part_of_the_state_is_drawn_by_the_script_into_a_part_of_the_page() {
    let html = ReportData { title: "t".into(), ..Default::default() }.to_html().expect("page");
    let state = embedded(&html, "state");
    for name in state.as_object().expect("an object").keys() {
        assert!(SCRIPT.contains(&format!("state.{name}")), "{name} is drawn nowhere");
    }
    for id in SCRIPT.split("byId(\"").skip(1).filter_map(|s| s.split('"').next()).filter(|id| !id.ends_with('-')) {
        assert!(html.contains(&format!("id=\"{id}\"")), "the page has no {id}");
    }
    assert!(html.contains("<h1 id=\"title\">t</h1>"));
}

#[test]
fn strange_numbers_do_not_break_the_page() {
    let mut data = sample();
    data.map[0].cameras.push([f64::NAN, f64::INFINITY]);
    data.timings[0].seconds = f64::NAN;
    data.models[0].psnr = Some(f64::INFINITY);
    data.aircraft.push(Craft {
        at: Some([f64::NAN; 3]),
        schedule: Schedule { left_s: Some(f64::INFINITY), ..Schedule::default() },
        ..Craft::new("west", "done")
    });
    let state = embedded(&data.to_html().expect("page"), "state").to_string();
    assert!(!state.contains("NaN") && !state.contains("inf\""), "{state}");
    data.comparisons[0].panels[0].1 = RgbImage::new(0, 0);
    assert!(data.to_html().is_err());
}

#[test]
fn figures_read_as_people_write_them() {
    assert_eq!(count(0), "0");
    assert_eq!(count(1_234_567), "1\u{202f}234\u{202f}567");
    assert_eq!((bytes(999), bytes(1536), bytes(20 << 20)), ("999 B".into(), "1.5 KiB".into(), "20 MiB".into()));
    assert_eq!((seconds(0.02), seconds(9.96), seconds(125.0)), ("20 ms".into(), "10.0 s".into(), "2 min 05 s".into()));
}
