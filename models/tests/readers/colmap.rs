//! COLMAP's models, binary and text.

use models::formats::colmap;

use crate::driver::{Read, Reader, Verdict, line, survive};

/// Little-endian fields of COLMAP's binary files.
#[derive(Default)]
struct Fields(Vec<u8>);

impl Fields {
    fn words(mut self, words: &[u32]) -> Self {
        self.0.extend(words.iter().flat_map(|w| w.to_le_bytes()));
        self
    }

    fn longs(mut self, longs: &[u64]) -> Self {
        self.0.extend(longs.iter().flat_map(|w| w.to_le_bytes()));
        self
    }

    fn numbers(mut self, numbers: &[f64]) -> Self {
        self.0.extend(numbers.iter().flat_map(|w| w.to_le_bytes()));
        self
    }

    fn bytes(mut self, bytes: &[u8]) -> Self {
        self.0.extend(bytes);
        self
    }
}

#[test]
fn colmap_cameras() {
    let opencv = Fields::default().longs(&[2]).words(&[1, 4]).longs(&[64, 48]).numbers(&[40.0, 41.0, 32.0, 24.0]);
    let opencv = opencv.numbers(&[0.01, -0.01, 0.001, 0.0]).words(&[2, 1]).longs(&[64, 48]);
    let simple = Fields::default().longs(&[1]).words(&[7, 0]).longs(&[640, 480]).numbers(&[400.0, 320.0, 240.0]);
    survive(&Reader {
        name: "colmap-cameras",
        seeds: vec![opencv.numbers(&[40.0, 41.0, 32.0, 24.0]).0, simple.0],
        text: false,
        shell: None,
        memory: (64 << 10, 32),
        read: Read::File("cameras.bin", &|path| line(colmap::read_cameras(path), |cameras| cameras.len() < 1000)),
    });
}

#[test]
fn colmap_images() {
    let image = |fields: Fields, id: u32| {
        let fields = fields.words(&[id]).numbers(&[1.0, 0.1, 0.0, 0.0, 3.0, -2.0, 60.0]).words(&[1]);
        fields.bytes(b"a/b.jpg\0").longs(&[1]).numbers(&[10.0, 20.0]).longs(&[u64::MAX])
    };
    let seeds = vec![image(image(Fields::default().longs(&[2]), 1), 2).0, image(Fields::default().longs(&[1]), 9).0];
    survive(&Reader {
        name: "colmap-images",
        seeds,
        text: false,
        shell: None,
        memory: (64 << 10, 32),
        read: Read::File("images.bin", &|path| {
            line(colmap::read_images(path), |images| {
                images.iter().all(|i| i.pose.center.is_finite() && i.pose.rotation.is_finite())
            })
        }),
    });
}

#[test]
fn colmap_points() {
    let point = |fields: Fields, id: u64| {
        let fields = fields.longs(&[id]).numbers(&[1.0, 2.0, 3.0]).bytes(&[1, 2, 3]).numbers(&[0.4]);
        fields.longs(&[2]).words(&[1, 5, 2, 6])
    };
    let seeds = vec![point(point(Fields::default().longs(&[2]), 1), 2).0, point(Fields::default().longs(&[1]), 7).0];
    survive(&Reader {
        name: "colmap-points",
        seeds,
        text: false,
        shell: None,
        memory: (64 << 10, 32),
        read: Read::File("points3D.bin", &|path| {
            let mut finite = true;
            let read = colmap::read_points(path, &mut |p| finite &= p.position.is_finite());
            line(read, |_| finite)
        }),
    });
}

fn text(name: &'static str, file: &'static str, seeds: [&str; 2], read: &dyn Fn(&std::path::Path) -> Verdict) {
    let seeds = seeds.map(|s| s.as_bytes().to_vec()).into();
    let read = Read::File(file, read);
    survive(&Reader { name, seeds, text: true, shell: None, memory: (64 << 10, 256), read });
}

#[test]
fn colmap_cameras_as_text() {
    let two = "# Camera list\n1 OPENCV 64 48 40 41 32 24 0.01 -0.01 0.001 0\n2 PINHOLE 64 48 40.5 41 32 24\n";
    let one = "7 SIMPLE_PINHOLE 640 480 400 320 240\n";
    let read = |path: &_| line(colmap::read_cameras(path), |cameras| cameras.len() < 1000);
    text("colmap-cameras-text", "cameras.txt", [two, one], &read);
}

#[test]
fn colmap_images_as_text() {
    let two = "# Image list\n1 1 0.1 0 0 3 -2 60 1 a/b c.jpg\n10.5 20 -1 11 21 7\n2 1 0 0 0 4 -2 60 1 b.jpg\n\n";
    let one = "9 0.7 0 0.7 0 1e2 0 -60 2 c.jpg\n10 20 -1\n";
    let read = |path: &_| {
        let finite = |i: &colmap::ColmapImage| i.pose.center.is_finite() && i.pose.rotation.is_finite();
        line(colmap::read_images(path), |images| images.iter().all(finite))
    };
    text("colmap-images-text", "images.txt", [two, one], &read);
}

#[test]
fn colmap_points_as_text() {
    let two = "# Points\n1 1.0 2.0 3.0 1 2 3 0.4 1 5 2 6\n2 1.5 -2 3 255 0 3 0.9 1 6\n";
    let one = "7 10 20 30 0 0 0 1 3 1\n";
    let read = |path: &_| {
        let mut finite = true;
        let read = colmap::read_points(path, &mut |p| finite &= p.position.is_finite());
        line(read, |_| finite)
    };
    text("colmap-points-text", "points3D.txt", [two, one], &read);
}

#[test]
fn colmap_origin() {
    let beside = [("cameras.txt", "1 PINHOLE 64 48 40.5 41 32 24\n"), ("images.txt", "1 1 0 0 0 3 -2 60 1 a.jpg\n\n")];
    let read = |path: &std::path::Path| {
        let folder = path.parent().expect("a folder");
        for (name, content) in beside.iter().filter(|b| !folder.join(b.0).exists()) {
            std::fs::write(folder.join(name), content).expect("written");
        }
        let model = colmap::Model::find(folder).expect("readable").expect("a model");
        line(model.read(), |r| r.origin.map_or(!path.is_file(), |o| o.is_valid()))
    };
    let seeds = [r#"{"lat":48.1,"lon":11.5,"alt":500.0}"#, "{\n\"lat\": -33,\n\"lon\": 151.25,\n\"alt\": -3\n}"];
    text("colmap-origin", "enu_origin_wgs84.json", seeds, &read);
}
