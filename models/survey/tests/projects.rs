//! Projects of other photogrammetry programs: a point of the ground lies in each picture where the program's own description of its cameras
//! says, computed here by the formulas of each format.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::Path;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DMat3, DVec2, DVec3};
use image::{Rgb, RgbImage};
use survey::coordinates::Reference;
use survey::dataset::Dataset;

const W: f64 = 640.0;
const H: f64 = 480.0;
/// A frame's numbers are f32: a thousandth of a pixel is not to be had everywhere.
const PIXELS: f64 = 2e-3;

fn picture(root: &Path, name: &str) {
    let path = root.join("images").join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    RgbImage::from_pixel(W as u32, H as u32, Rgb([90, 120, 60])).save(path).unwrap();
}

/// Cameras that look down at the origin of the ground from 50 m, each turned and tilted in another way; axes right, down, forwards.
fn cameras() -> Vec<(String, DMat3, DVec3)> {
    (0..5)
        .map(|i| {
            let k = f64::from(i);
            let down = DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z);
            let turn = DMat3::from_rotation_z(0.7 * k) * DMat3::from_rotation_x(0.1 * k - 0.2) * down;
            (format!("DJI_{:04}.JPG", i + 1), turn, DVec3::new(4.0 * k - 8.0, 3.0 - k, 50.0 + k))
        })
        .collect()
}

const GROUND: [[f64; 3]; 4] = [[1.0, 2.0, 0.0], [-6.0, 5.0, 1.5], [8.0, -4.0, -2.0], [0.0, 0.0, 3.0]];

/// Where the frame of this name sees a point.
fn seen(set: &Dataset, name: &str, point: DVec3) -> DVec2 {
    let stem = |n: &str| n.rsplit_once('.').map_or(n.to_owned(), |(stem, _)| stem.to_owned());
    let frame = set.frames.iter().find(|f| stem(&f.name) == stem(name)).unwrap_or_else(|| panic!("{name}"));
    let pose = frame.view.pose;
    let p = pose.rotation.conjugate() * (point - pose.center);
    let (x, y) = frame.distortion.distort(p.x / p.z, p.y / p.z);
    let i = &frame.view.intrinsics;
    DVec2::new(f64::from(i.fx) * x + f64::from(i.cx), f64::from(i.fy) * y + f64::from(i.cy))
}

fn agree(set: &Dataset, of: impl Fn(&DMat3, DVec3, DVec3) -> DVec2, moved: impl Fn(DVec3) -> DVec3) {
    assert_eq!(set.frames.len(), 5);
    for (name, turn, center) in cameras() {
        for point in GROUND.map(DVec3::from) {
            let (theirs, ours) = (of(&turn, center, point), seen(set, &name, moved(point)));
            assert!((theirs - ours).length() < PIXELS, "{name}: {theirs} {ours}");
        }
    }
}

#[test]
fn metashapes_cameras_are_where_its_manual_says_around_the_earth_and_in_local_metres() {
    let [f, cx, cy, k1, k2, k3, k4, p1, p2, b1] = [500.0, 3.2, -4.1, -0.05, 0.02, -0.01, 0.004, 0.0011, -0.0007, 1.5];
    // As the manual has it: x' by P1 (r² + 2x²) + 2 P2 x y.
    let of = |turn: &DMat3, center: DVec3, point: DVec3| {
        let p = turn.transpose() * (point - center);
        let (x, y) = (p.x / p.z, p.y / p.z);
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2.powi(3) + k4 * r2.powi(4);
        let xd = x * radial + p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y;
        let yd = y * radial + p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y;
        DVec2::new(0.5 * W + cx + xd * f + xd * b1, 0.5 * H + cy + yd * f)
    };
    let origin = Geodetic { lat_deg: 47.2, lon_deg: 8.9, alt_m: 480.0 };
    let frame = EnuFrame::new(origin);
    for geocentric in [true, false] {
        let folder = tempfile::tempdir().unwrap();
        // The chunk's own frame: half the size, turned and moved.
        let (scale, turn, shift) =
            (2.0, DMat3::from_rotation_y(0.4) * DMat3::from_rotation_z(1.1), DVec3::new(3.0, -7.0, 2.0));
        let own = |p: DVec3| turn.transpose() * (p - shift) / scale;
        // From there to east, north, up, and on to the middle of the Earth.
        let (to_world, to_shift) = match geocentric {
            true => (frame.axes().transpose() * turn, frame.to_geodetic(shift).to_ecef()),
            false => (turn, shift),
        };
        let row = |m: DMat3| m.transpose().to_cols_array().map(|v| format!("{v:.17e}")).join(" ");
        let mut xml = String::from(
            "\u{feff}<?xml version=\"1.0\"?><document version=\"1.5.0\"><chunk label=\"a\"><sensors><sensor id=\"3\" type=\"frame\">",
        );
        xml += &format!(
            "<resolution width=\"640\" height=\"480\"/><calibration type=\"frame\" class=\"initial\"><f>1</f></calibration>\
             <calibration type=\"frame\" class=\"adjusted\"><resolution width=\"640\" height=\"480\"/><f>{f}</f><cx>{cx}</cx><cy>{cy}</cy>\
             <b1>{b1}</b1><k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3><k4>{k4}</k4><p1>{p1}</p1><p2>{p2}</p2></calibration></sensor></sensors><cameras><group>"
        );
        for (i, (name, camera, center)) in cameras().into_iter().enumerate() {
            picture(folder.path(), &name.replace(".JPG", ".png"));
            let (r, c) = (turn.transpose() * camera, own(center));
            let m = [
                [r.x_axis.x, r.y_axis.x, r.z_axis.x, c.x],
                [r.x_axis.y, r.y_axis.y, r.z_axis.y, c.y],
                [r.x_axis.z, r.y_axis.z, r.z_axis.z, c.z],
                [0.0, 0.0, 0.0, 1.0],
            ];
            let m: Vec<String> = m.iter().flatten().map(|v| format!("{v:.17e}")).collect();
            let label = name.trim_end_matches(".JPG");
            xml += &format!(
                "<camera id=\"{i}\" sensor_id=\"3\" label=\"{label}\"><transform>{}</transform></camera>",
                m.join(" ")
            );
        }
        xml += "<camera id=\"9\" sensor_id=\"3\" label=\"untied\"/></group></cameras><transform>";
        xml += &format!(
            "<rotation>{}</rotation><translation>{:.12e} {:.12e} {:.12e}</translation><scale>{scale}</scale></transform></chunk></document>",
            row(to_world),
            to_shift.x,
            to_shift.y,
            to_shift.z
        );
        std::fs::write(folder.path().join("cameras.xml"), xml).unwrap();
        let set = Dataset::open(folder.path()).unwrap();
        assert_eq!(set.origin.is_some(), geocentric);
        let there = |p: DVec3| match set.origin {
            Some(own) => EnuFrame::new(own).to_enu(frame.to_geodetic(p)),
            None => p,
        };
        agree(&set, of, there);
    }
}

#[test]
fn realityscans_table_is_read_by_its_columns() {
    let [f, px, py, k1, k2, t1, t2] = [28.0, 0.005, -0.014, -0.04, 0.01, 0.0006, -0.0009];
    let of = |turn: &DMat3, center: DVec3, point: DVec3| {
        let p = turn.transpose() * (point - center);
        let (x, y) = (p.x / p.z, p.y / p.z);
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
        let xd = x * radial + 2.0 * t1 * x * y + t2 * (r2 + 2.0 * x * x);
        let yd = y * radial + t1 * (r2 + 2.0 * y * y) + 2.0 * t2 * x * y;
        DVec2::new(xd * f / 36.0 * W + 0.5 * W + px * W, yd * f / 36.0 * W + 0.5 * H + py * W)
    };
    let folder = tempfile::tempdir().unwrap();
    let mut table = String::from("#cameras 6\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n");
    for (name, turn, center) in cameras() {
        let name = name.replace(".JPG", ".png");
        picture(folder.path(), &name);
        // heading about −z, then pitch about x, then roll about y, of axes right, up, backwards.
        let m = DMat3::from_cols(turn.x_axis, -turn.y_axis, -turn.z_axis);
        let pitch = m.y_axis.z.asin();
        let roll = (-m.x_axis.z).atan2(m.z_axis.z);
        let heading = -((-m.y_axis.x).atan2(m.y_axis.y));
        let [h, p, r] = [heading, pitch, roll].map(f64::to_degrees);
        table += &format!(
            "{name},{},{},{},{h},{p},{r},{f},{px},{py},{k1},{k2},0,0,{t1},{t2}\n",
            center.x, center.y, center.z
        );
    }
    table += "gone.png,1,2,3,0,0,0,28,0,0,0,0,0,0,0,0\n";
    std::fs::write(folder.path().join("cameras.csv"), table).unwrap();
    agree(&Dataset::open(folder.path()).unwrap(), of, |p| p);
}

#[test]
fn bundlers_cameras_look_along_minus_z() {
    let [f, k1, k2] = [510.0, -0.06, 0.02];
    // P = R X + t, p = −P / P.z, p' = f · r(p) · p from the middle, y upwards.
    let of = |turn: &DMat3, center: DVec3, point: DVec3| {
        let r = DMat3::from_cols(turn.x_axis, -turn.y_axis, -turn.z_axis).transpose();
        let p = r * point - r * center;
        let (x, y) = (-p.x / p.z, -p.y / p.z);
        let r2 = x * x + y * y;
        let scale = f * (1.0 + k1 * r2 + k2 * r2 * r2);
        DVec2::new(0.5 * W + scale * x, 0.5 * H - scale * y)
    };
    let folder = tempfile::tempdir().unwrap();
    let (mut file, mut list) = (String::from("# Bundle file v0.3\n6 0\n"), String::new());
    for (name, turn, center) in cameras() {
        let name = name.replace(".JPG", ".png");
        picture(folder.path(), &name);
        let r = DMat3::from_cols(turn.x_axis, -turn.y_axis, -turn.z_axis).transpose();
        let t = -(r * center);
        let rows = r.transpose().to_cols_array();
        file += &format!(
            "{f} {k1} {k2}\n{} {} {}\n{} {} {}\n{} {} {}\n{} {} {}\n",
            rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7], rows[8], t.x, t.y, t.z
        );
        list += &format!("{name} 0 512.5\n");
    }
    file += "0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n";
    list += "untied.png\n";
    std::fs::write(folder.path().join("bundle.out"), file).unwrap();
    std::fs::write(folder.path().join("list.txt"), list).unwrap();
    agree(&Dataset::open(folder.path()).unwrap(), of, |p| p);
}

/// A project of Pix4D in UTM zone 32, moved near zero by `shift`, and where its frame's zero is on Earth.
fn write_opf(root: &Path, uri: &str) -> (DVec3, Reference) {
    let shift = DVec3::new(-650_000.0, -5_230_000.0, -400.0);
    let mut named = Vec::new();
    let mut posed = Vec::new();
    for (i, (name, turn, center)) in cameras().into_iter().enumerate() {
        let name = name.replace(".JPG", ".png");
        picture(root, &name);
        let m = DMat3::from_cols(turn.x_axis, -turn.y_axis, -turn.z_axis);
        // R = Rx(ω) Ry(φ) Rz(κ).
        let phi = m.z_axis.x.asin();
        let omega = (-m.z_axis.y).atan2(m.z_axis.z);
        let kappa = (-m.y_axis.x).atan2(m.x_axis.x);
        let angles = [omega, phi, kappa].map(f64::to_degrees);
        named.push(format!(r#"{{"id":{i},"uri":"{uri}{name}"}}"#));
        posed.push(format!(
            r#"{{"id":{i},"sensor_id":7,"position":{:?},"orientation_deg":{angles:?}}}"#,
            center.to_array()
        ));
    }
    let write = |name: &str, text: String| std::fs::write(root.join(name), text).unwrap();
    let [cameras, calibrated, frame] = ["opf-camera-list", "opf-calibrated-cameras", "opf-scene-reference-frame"]
        .map(|f| format!("application/{f}+json"));
    write("cameras.json", format!(r#"{{"format":"{cameras}","version":"1.0","cameras":[{}]}}"#, named.join(",")));
    write(
        "calibrated.json",
        format!(
            r#"{{"format":"{calibrated}","version":"1.0","cameras":[{}],"sensors":[{{"id":7,"internals":{{"type":"perspective",
            "principal_point_px":[322.5,236.25],"focal_length_px":505.0,"radial_distortion":[-0.05,0.01,0.002],
            "tangential_distortion":[0.0012,-0.0004]}}}}]}}"#,
            posed.join(",")
        ),
    );
    write(
        "frame.json",
        format!(
            r#"{{"format":"{frame}","version":"1.0","crs":{{"definition":"EPSG:32632+5773"}},
            "base_to_canonical":{{"shift":{:?},"scale":[1,1,1],"swap_xy":false}}}}"#,
            shift.to_array()
        ),
    );
    let resource = |format: &str, uri: &str| {
        format!(r#"{{"id":"a","type":"t","sources":[],"resources":[{{"uri":"{uri}","format":"{format}"}}]}}"#)
    };
    let items = [
        resource(&cameras, "cameras.json"),
        resource(&calibrated, "./calibrated.json"),
        resource(&frame, "frame.json"),
    ];
    write(
        "field.opf",
        format!(
            r#"{{"format":"application/opf-project+json","version":"1.0","name":"a","id":"b","items":[{}]}}"#,
            items.join(",")
        ),
    );
    (shift, Reference::named("EPSG:32632").unwrap().unwrap())
}

#[test]
fn pix4ds_project_is_brought_from_its_projection_to_the_ground() {
    for uri in ["", "file:///c:/data/images/"] {
        let folder = tempfile::tempdir().unwrap();
        let (shift, map) = write_opf(folder.path(), uri);
        let of = |turn: &DMat3, center: DVec3, point: DVec3| {
            let p = turn.transpose() * (point - center);
            let (x, y) = (p.x / p.z, p.y / p.z);
            let r2 = x * x + y * y;
            let radial = 1.0 - 0.05 * r2 + 0.01 * r2 * r2 + 0.002 * r2.powi(3);
            // T1 (r² + 2x²) + 2 T2 x y, as Pix4D writes it.
            let xd = x * radial + 2.0 * -0.0004 * x * y + 0.0012 * (r2 + 2.0 * x * x);
            let yd = y * radial + 2.0 * 0.0012 * x * y - 0.0004 * (r2 + 2.0 * y * y);
            DVec2::new(505.0 * xd + 322.5, 505.0 * yd + 236.25)
        };
        let set = Dataset::open(folder.path()).unwrap();
        let enu = EnuFrame::new(set.origin.unwrap());
        assert!((set.origin.unwrap().lat_deg - 47.2).abs() < 0.1 && (set.origin.unwrap().lon_deg - 10.97).abs() < 0.1);
        // A projection is not to scale: a part in some thousands, which at 50 m is a pixel. Within that its own place is ours.
        for (name, turn, center) in cameras() {
            for point in GROUND.map(DVec3::from) {
                let theirs = of(&turn, center, point);
                let ours = seen(&set, &name, enu.to_enu(map.geodetic(point - shift).unwrap()));
                assert!((theirs - ours).length() < 0.3, "{name}: {theirs} {ours}");
            }
        }
        // North of the projection is 1.4° off here: far more than a pixel.
        let convergence =
            enu.to_enu(map.geodetic(DVec3::Y * 100.0 - shift).unwrap()) - enu.to_enu(map.geodetic(-shift).unwrap());
        assert!(convergence.x.abs() > 1.0, "{convergence}");
    }
}

#[test]
fn what_is_damaged_or_not_known_is_refused_in_one_line_that_names_the_file() {
    let refused = |name: &str, from: &str, to: &str, word: &str| {
        let folder = tempfile::tempdir().unwrap();
        write_opf(folder.path(), "");
        let path = folder.path().join(name);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{from}");
        std::fs::write(&path, text.replace(from, to)).unwrap();
        let said = Dataset::open(folder.path()).unwrap_err().to_string();
        assert!(
            said.contains(word) && said.contains(".json") | said.contains(".opf") && !said.contains('\n'),
            "{said}"
        );
    };
    refused("calibrated.json", "\"perspective\"", "\"spherical\"", "spherical");
    refused("calibrated.json", "\"sensor_id\":7", "\"sensor_id\":8", "sensor that is not there");
    refused("calibrated.json", "505.0", "-5", "focal");
    refused("calibrated.json", "505.0", "[", "not as the format says");
    refused("field.opf", "./calibrated.json", "../calibrated.json", "outside of the project's folder");
    refused("field.opf", "./calibrated.json", "./cali\\n INFO forged.json", "is no name of a file");
    refused("frame.json", "EPSG:32632", "EPSG:1", "not known");
    let folder = tempfile::tempdir().unwrap();
    let deep = format!("<document><chunk>{}</chunk></document>", "<a>".repeat(9_000));
    std::fs::write(folder.path().join("cameras.xml"), deep).unwrap();
    assert!(Dataset::open(folder.path()).unwrap_err().to_string().contains("nested"));
    std::fs::write(folder.path().join("cameras.xml"), "<document><chunk/></document>").unwrap();
    assert!(Dataset::open(folder.path()).unwrap_err().to_string().contains("no camera that has a pose"));
}
