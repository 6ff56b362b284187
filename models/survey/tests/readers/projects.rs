//! Projects of other photogrammetry programs, each with the pictures it speaks of.

use std::path::Path;

use image::{Rgb, RgbImage};
use models::camera::View;
use survey::dataset::Dataset;

use crate::driver::{Read, Reader, line, survive_part};

/// Reads the project in whose folder `path` lies, beside pictures and `others`.
fn survive_in_a_project(name: &'static str, file: &'static str, seeds: &[&str], others: &[(&str, &str)]) {
    let others: Vec<_> = others.iter().filter(|(other, _)| *other != file).collect();
    let read = |path: &Path| {
        let folder = path.parent().expect("a folder");
        if !folder.join("images").exists() {
            std::fs::create_dir(folder.join("images")).expect("a folder");
            for picture in ["a.png", "b.png"] {
                RgbImage::from_pixel(64, 48, Rgb([90, 120, 60]))
                    .save(folder.join("images").join(picture))
                    .expect("written");
            }
            others.iter().for_each(|(name, text)| std::fs::write(folder.join(name), text).expect("written"));
        }
        let opened = Dataset::open(folder).map_err(|e| match e.to_string() {
            // Of a picture that is not there its own name is said, wherever that leads.
            said if said.contains("is the picture folder complete?") => format!("{}: {said}", path.display()),
            said => said,
        });
        line(opened, |set| {
            let posed = |v: &View| v.pose.center.is_finite() && v.pose.rotation.is_finite();
            // A focal length that is none is refused with its picture.
            let sized = |v: &View| v.intrinsics.width.max(v.intrinsics.height) <= 1 << 16;
            let is_sound = |v: &View| posed(v) && sized(v);
            // Without a project the pictures are what there is.
            set.origin.is_none_or(|o| o.is_valid()) && set.frames.iter().all(|f| is_sound(&f.view))
        })
    };
    let reader = Reader {
        name,
        seeds: seeds.iter().map(|s| s.as_bytes().to_vec()).collect(),
        text: true,
        shell: None,
        memory: (512 << 10, 512),
        read: Read::File(file, &read),
    };
    survive_part(&reader, 10);
}

#[test]
fn cameras_of_metashape() {
    let head = "<?xml version=\"1.0\"?>\n<document version=\"1.5.0\"><chunk label=\"a\"><sensors><sensor id=\"3\" type=\"frame\">\n\
        <resolution width=\"64\" height=\"48\"/>\n<calibration type=\"frame\" class=\"adjusted\">\n<resolution width=\"64\" height=\"48\"/>\n\
        <f>50</f>\n<cx>0.5</cx>\n<cy>-0.4</cy>\n<b1>0.1</b1>\n<k1>-0.05</k1>\n<p1>0.001</p1>\n</calibration>\n</sensor>\n</sensors>\n<cameras>\n";
    let camera = |label: &str, x: f64| {
        let transform = format!("1 0 0 {x}\n0 -1 0 3\n0 0 -1 50\n0 0 0 1");
        format!(
            "<camera id=\"{x}\" sensor_id=\"3\" label=\"{label}\">\n<transform>\n{transform}\n</transform>\n</camera>\n"
        )
    };
    let placed = "<transform>\n<rotation>1 0 0 0 1 0 0 0 1</rotation>\n<translation>4278990.5\n670159.25 4666190</translation>\n\
        <scale>2</scale>\n</transform>\n";
    let end = |placed: &str| format!("</cameras>\n{placed}</chunk>\n</document>\n");
    let [local, geocentric] = ["", placed].map(|p| format!("{head}{}{}{}", camera("a", 0.0), camera("b", 5.0), end(p)));
    survive_in_a_project("metashape", "cameras.xml", &[&local, &geocentric], &[]);
}

#[test]
fn cameras_of_realityscan() {
    let head = "#cameras 2\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n";
    let rows =
        "a.png,1,2,50,10,0,0,28,0.005,-0.01,-0.04,0.01,0,0,0.0006,-0.0009\nb.png,5,2,51,20.5,1,-2,28,0,0,0,0,0,0,0,0\n";
    let one = "#cameras 1\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\na.png,1,2,3,0,-90,0,28,0,0,0,0,0,0,0,0\n";
    survive_in_a_project("realityscan", "cameras.csv", &[&format!("{head}{rows}"), one], &[]);
}

#[test]
fn cameras_of_bundler() {
    let camera = |x: f64| format!("50 -0.06 0.02\n1 0 0\n0 1 0\n0 0 1\n{x} -3 -50\n");
    let two =
        format!("# Bundle file v0.3\n2 1\n{}{}1.5 2 0\n90 120 60\n2 0 5 1.5 2 1 6 3 4\n", camera(0.0), camera(5.0));
    let untied = format!("# Bundle file v0.3\n2 0\n{}0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n", camera(1.0));
    let list = ("list.txt", "a.png 0 51\nb.png\n");
    survive_in_a_project("bundler", "bundle.out", &[&two, &untied], &[list]);
    survive_in_a_project("bundler-list", "list.txt", &[list.1, "a.png\nb.png 0 50.5\n"], &[("bundle.out", &two)]);
}

const OPF: [(&str, &str); 4] = [
    (
        "field.opf",
        "{\"format\":\"application/opf-project+json\",\n\"version\":\"1.0\",\n\"name\":\"a\",\n\"id\":\"b\",\n\"items\":[\n\
         {\"id\":\"a\",\"type\":\"t\",\"sources\":[],\n\"resources\":[{\"uri\":\"cameras.json\",\n\"format\":\"application/opf-camera-list+json\"}]},\n\
         {\"id\":\"a\",\"type\":\"t\",\"sources\":[],\n\"resources\":[{\"uri\":\"./calibrated.json\",\n\"format\":\"application/opf-calibrated-cameras+json\"}]},\n\
         {\"id\":\"a\",\"type\":\"t\",\"sources\":[],\n\"resources\":[{\"uri\":\"frame.json\",\n\"format\":\"application/opf-scene-reference-frame+json\"}]}\n]}\n",
    ),
    (
        "cameras.json",
        "{\"format\":\"application/opf-camera-list+json\",\n\"version\":\"1.0\",\n\"cameras\":[\n{\"id\":0,\n\"uri\":\"a.png\"},\n\
         {\"id\":1,\n\"uri\":\"file:///c:/data/b.png\"}\n]}\n",
    ),
    (
        "calibrated.json",
        "{\"format\":\"application/opf-calibrated-cameras+json\",\n\"version\":\"1.0\",\n\"cameras\":[\n\
         {\"id\":0,\n\"sensor_id\":7,\n\"position\":[0,\n3,50],\n\"orientation_deg\":[1.5,\n2,10]},\n\
         {\"id\":1,\n\"sensor_id\":7,\n\"position\":[5,\n3,51],\n\"orientation_deg\":[0,\n-2,80]}\n],\n\
         \"sensors\":[{\"id\":7,\n\"internals\":{\"type\":\"perspective\",\n\"principal_point_px\":[32.5,\n23.5],\n\"focal_length_px\":50,\n\
         \"radial_distortion\":[-0.05,\n0.01,0.002],\n\"tangential_distortion\":[0.0012,-0.0004]}}]}\n",
    ),
    (
        "frame.json",
        "{\"format\":\"application/opf-scene-reference-frame+json\",\n\"version\":\"1.0\",\n\"crs\":{\"definition\":\"EPSG:32632+5773\"},\n\
         \"base_to_canonical\":{\"shift\":[-650000,\n-5230000,-400],\n\"scale\":[1,1,1],\n\"swap_xy\":false}}\n",
    ),
];

#[test]
fn projects_of_pix4d() {
    let names = ["opf-project", "opf-cameras", "opf-calibrated", "opf-frame"];
    for ((file, text), name) in OPF.into_iter().zip(names) {
        survive_in_a_project(name, file, &[text], &OPF);
    }
}
