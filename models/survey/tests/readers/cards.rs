//! A card's pictures, what they say of themselves, and the files and logs beside them.

use std::io::Cursor;
use std::path::Path;

use geometry::geodesy::Geodetic;
use image::{ImageFormat, Rgb, RgbImage};
use models::picture;
use survey::card::exposures::match_exposures;
use survey::card::log;
use survey::card::log::dataflash;
use survey::card::write::{PIX4D, Tags};
use survey::card::{Card, CardOptions, control, geotags};

use crate::driver::{Read, Reader, Shell, Verdict, line, survive};

const HOME: Geodetic = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 158.5 };
/// What the decoders of pictures take beside the picture: tables, and rows read ahead.
const DECODER: usize = 2 << 20;

fn encoded(format: ImageFormat) -> Vec<u8> {
    let image = RgbImage::from_fn(16, 12, |x, y| Rgb([(x * 16) as u8, (y * 20) as u8, 90]));
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).expect("encoded");
    bytes.into_inner()
}

fn tagged(tags: &Tags) -> Vec<u8> {
    tags.into_jpeg(&encoded(ImageFormat::Jpeg)).expect("tagged")
}

fn dji() -> Tags {
    Tags {
        camera: Some(("DJI".into(), "FC300S".into())),
        time_ns: Some(1_466_699_519_123_000_000),
        position: Some(HOME),
        dop: Some(1.2),
        focal_35mm: Some(20),
        orientation: Some(6),
        ..Tags::default()
    }
    .with_dji([45.0, -90.0, 0.0], 40.0)
}

fn pix4d() -> Tags {
    let named = [("Yaw", "12.5"), ("Pitch", "1/2"), ("Roll", "-3"), ("GPSXYAccuracy", "0.5"), ("GPSZAccuracy", "1.5")];
    let xmp = named.map(|(name, value)| (PIX4D.into(), name.into(), value.into())).into();
    Tags { camera: Some(("senseFly".into(), "S.O.D.A.".into())), position: Some(HOME), xmp, ..Tags::default() }
}

/// Opens the card that consists of this one picture.
fn card(path: &Path) -> Verdict {
    let folder = path.parent().expect("a folder").to_owned();
    line(Card::open(&[folder], &CardOptions::default()), |card| {
        card.origin.is_none_or(|origin| origin.is_valid())
            && card.pictures.iter().all(|p| {
                let (pose, sigma) = (p.prior.pose, p.prior.sigma);
                pose.center.is_finite()
                    && (pose.rotation.length() - 1.0).abs() < 1e-6
                    && sigma.position_m.iter().chain(&sigma.rotation_rad).all(|s| *s > 0.0)
                    && p.focal_sigma > 0.0
            })
    })
}

/// Card readers work in rayon's threads; the memory of one thread is what is counted.
fn in_this_thread(test: impl FnOnce() + Send) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build().expect("a pool");
    pool.install(test);
}

/// The segment of a JPEG that begins with `name`: where its length stands, and where it ends.
fn segment(jpeg: &[u8], name: &[u8]) -> (usize, usize) {
    let at = jpeg.windows(name.len()).position(|w| w == name).expect("the segment") - 2;
    (at, at + usize::from(u16::from_be_bytes([jpeg[at], jpeg[at + 1]])))
}

/// A JPEG with another segment of the same name.
fn with_segment(jpeg: &[u8], name: &[u8], content: &[u8]) -> Vec<u8> {
    let (from, to) = segment(jpeg, name);
    let content = &content[..content.len().min(65_000)];
    let length = (content.len() + name.len() + 2) as u16;
    [&jpeg[..from], &length.to_be_bytes(), name, content, &jpeg[to..]].concat()
}

fn content(jpeg: &[u8], name: &[u8]) -> Vec<u8> {
    let (from, to) = segment(jpeg, name);
    jpeg[from + 2 + name.len()..to].to_vec()
}

const EXIF: &[u8] = b"Exif\0\0";
const XMP: &[u8] = b"http://ns.adobe.com/xap/1.0/\0";

#[test]
fn exif_of_a_card() {
    let shell = Shell {
        open: |jpeg| content(jpeg, EXIF),
        close: |exif| with_segment(&tagged(&Tags { xmp: Vec::new(), ..dji() }), EXIF, &exif),
    };
    in_this_thread(|| {
        survive(&Reader {
            name: "card-exif",
            seeds: vec![tagged(&Tags { xmp: Vec::new(), ..dji() }), tagged(&Tags { xmp: Vec::new(), ..pix4d() })],
            text: false,
            shell: Some(shell),
            memory: (512 << 10, 64),
            read: Read::File("DJI_0001.JPG", &card),
        });
    });
}

#[test]
fn xmp_of_a_card() {
    let shell = Shell { open: |jpeg| content(jpeg, XMP), close: |xmp| with_segment(&tagged(&dji()), XMP, &xmp) };
    // Values on lines of their own, so that whole ones are lost, doubled and exchanged.
    let lined = |tags: &Tags| {
        let jpeg = tagged(tags);
        let packet = String::from_utf8(content(&jpeg, XMP)).expect("text").replace(" n", "\nn").replace("/>", "\n/>");
        with_segment(&jpeg, XMP, packet.as_bytes())
    };
    in_this_thread(|| {
        survive(&Reader {
            name: "card-xmp",
            seeds: vec![lined(&dji()), lined(&pix4d())],
            text: true,
            shell: Some(shell),
            memory: (512 << 10, 256),
            read: Read::File("DJI_0001.JPG", &card),
        });
    });
}

#[test]
fn png_and_tiff_of_a_card() {
    in_this_thread(|| {
        survive(&Reader {
            name: "card-png-tiff",
            seeds: vec![encoded(ImageFormat::Png), encoded(ImageFormat::Tiff)],
            text: false,
            shell: None,
            // A tag of a TIFF may take a MiB and is held as one number of 32 bytes for each of it.
            memory: (DECODER + (32 << 20), 64),
            // They say nothing of where they were taken: a file beside the card does.
            read: Read::File("a.png", &|path| {
                let folder = path.parent().expect("a folder").to_owned();
                let beside = folder.join("geo.txt");
                if !beside.exists() {
                    std::fs::write(&beside, "EPSG:4326\na.png -91.9945 46.8426 198.3\n").expect("written");
                }
                line(Card::open(&[folder], &CardOptions::default()), |card| card.pictures.len() == 1)
            }),
        });
    });
}

#[test]
fn pixels() {
    survive(&Reader {
        name: "pixels",
        seeds: vec![encoded(ImageFormat::Jpeg), encoded(ImageFormat::Png), encoded(ImageFormat::Tiff)],
        text: false,
        shell: None,
        // A few bytes can declare the largest picture there may be.
        memory: (DECODER + 4 * (models::camera::MAX_EDGE as usize).pow(2), 256),
        read: Read::File("a.jpg", &|path| {
            line(picture::decode(path), |image| image.width().max(image.height()) <= models::camera::MAX_EDGE)
        }),
    });
}

#[test]
fn files_of_positions() {
    let ours = "picture,sequence,lat_deg,lon_deg,alt_m,east_m,north_m,up_m,qw,qx,qy,qz,sigma_m,sigma_deg,speed_m_s,key_frame\n\
                IMG_1.png,1,46.8426,-91.9945,198.3,0,0,0,0,1,0,0,0.8,2,5,1\nIMG_2.png,2,46.8427,-91.9945,198.3,0,9,0,0,1,0,0,0.8,2,5,1\n";
    let planner =
        "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\nIMG_1.JPG 46.8426 -91.9945 198.3 90 0 0 0\n";
    let degrees = "EPSG:4326\nIMG_1.JPG -91.9945 46.8426 198.3 90 0 0 0.8 1.5\n";
    let utm = "WGS84 UTM 15N\nIMG_1.JPG 576700.5 5188000 198.3\n# a note\nIMG_2.JPG 576710 5188000 198.3\n";
    let exiftool = "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\nDCIM/IMG_1.JPG,\"46 deg 50' 33.39\"\" N\",\"91 deg 59' 40.42\"\" W\",198.3 m Above Sea Level\n";
    let german = "Bild;Rechtswert;Hochwert;H\u{f6}he;Zone\nIMG_1.JPG;576700,5;5188000;198,3;15N\nIMG_2.JPG;576710;5188000;198,3;15N\n";
    let pix4d = "IMG_1.JPG,46.8426,-91.9945,198.3,5.0,10.0\nIMG_2.JPG,46.8427,-91.9945,198.3,5.0,10.0\n";
    survive(&Reader {
        name: "geotags",
        seeds: [ours, planner, degrees, utm, exiftool, german, pix4d].map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (64 << 10, 64),
        read: Read::File("geo.txt", &|path| {
            line(geotags::read(path), |found: geotags::Geotags| {
                found.tags.iter().all(|(_, t)| {
                    let turned = t.attitude.is_none_or(|a| (a.rotation.length() - 1.0).abs() < 1e-6);
                    t.fix.position.is_valid() && t.fix.sigma_m.iter().all(|s| *s > 0.0) && turned
                })
            })
        }),
    });
}

#[test]
fn lists_of_surveyed_points() {
    let utm = "WGS84 UTM 17N\n333158.20\t3102916.18\t3\t2699.43\t1668.72\tDJI_0065.JPG\n\
               333158.20 3102916.18 3 2706.86 1960.27 DJI_0066.JPG\n# a note\n";
    let named = "EPSG:4326\n7.00001 46.0 400 1 2 a.jpg church 0.01 0.02\n7.00002,46.0,400,3,4,a.jpg\n";
    let projected = "+proj=utm +zone=15 +datum=WGS84\n576700.5 5188000 198.3 10 20 IMG_1.JPG\n";
    survive(&Reader {
        name: "surveyed points",
        seeds: [utm, named, projected].map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (64 << 10, 64),
        read: Read::File("gcp_list.txt", &|path| {
            line(control::read(path), |points: Vec<control::SurveyedPoint>| {
                points.iter().all(|p| {
                    let marks = p.marks.iter().flat_map(|(_, at)| at).all(|v| v.is_finite());
                    p.position.is_valid() && p.sigma_m.iter().all(|s| *s > 0.0) && marks && !p.marks.is_empty()
                })
            })
        }),
    });
}

/// A log of `n` exposures as ArduCopter writes it, or of the commands alone, with other messages and holes between.
fn log(name: &str, n: u32) -> Vec<u8> {
    let format = |id: u8, length: u8, texts: [(&str, usize); 3]| {
        let mut message = vec![0xA3, 0x95, 128, id, length];
        for (text, size) in texts {
            message.extend(text.bytes().chain(std::iter::repeat(0)).take(size));
        }
        message
    };
    let labels = "TimeUS,I,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y";
    let mut log = format(200, 11, [("XYZ", 4), ("Q", 16), ("TimeUS", 64)]);
    log.extend(format(201, 44, [(name, 4), ("QBIHLLeeeccC", 16), (labels, 64)]));
    for i in 0..n {
        log.extend([&[0xA3, 0x95, 200], &7u64.to_le_bytes()[..], &[0xA3, 0, 0x95, 0xA3, 0x95, 201]].concat());
        log.extend((1_000_000 + 2_000_000 * u64::from(i)).to_le_bytes());
        log.extend([0; 7]);
        let numbers = [468_426_000 + 1000 * i as i32, -919_945_000, 19_830, 4_000, 19_900];
        log.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
        log.extend([1000i16, -500, 9000].iter().flat_map(|v| v.to_le_bytes()));
    }
    log
}

#[test]
fn dataflash_logs() {
    // Pictures of a camera whose clock is off by an hour.
    let pictures: Vec<_> = (0..5).map(|i| Some((3600.0 + 2.0 * f64::from(i), 0.001))).collect();
    survive(&Reader {
        name: "dataflash",
        seeds: vec![log("CAM", 5), log("TRIG", 3)],
        text: false,
        shell: None,
        memory: (160 << 10, 64),
        read: Read::File("1.BIN", &|path| {
            line(dataflash::read(path), |series| {
                let found: Vec<_> = series.into_iter().flat_map(|s| s.exposures).collect();
                let times: Vec<f64> = found.iter().map(|e| e.time_s).collect();
                let matched = match_exposures(&pictures, &times);
                let known = |i: &usize| *i < times.len();
                found.iter().all(|e| e.fix.position.is_valid()) && matched.exposure.iter().flatten().all(known)
            })
        }),
    });
}

#[test]
fn dataflash_logs_as_text() {
    let head = "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\nFMT, 43, 45, CAM, QBIHLLeccC, TimeUS,I,GPSTime,GPSWeek,Lat,Lng,Alt,R,P,Y\n";
    let line =
        |i: u32| format!("CAM, {}, 0, {}, 1902, 46.8426{i}, -91.9945, 198.31, 1, -2, 90\n", 1_000_000 * i, 1000 * i);
    let text: String = std::iter::once(head.to_owned()).chain((0..5).map(line)).collect();
    survive(&Reader {
        name: "dataflash-text",
        seeds: vec![text.into_bytes()],
        text: true,
        shell: None,
        memory: (160 << 10, 64),
        read: Read::File("1.log", &logged),
    });
}

/// A PX4 log of captures, with a position and an attitude between.
fn ulog() -> Vec<u8> {
    let message = |kind: u8, content: &[u8]| [&(content.len() as u16).to_le_bytes()[..], &[kind], content].concat();
    let mut log = [&[0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35, 1][..], &7u64.to_le_bytes()].concat();
    log.extend(message(b'B', &[0; 40]));
    let formats = [
        "camera_capture:uint64_t timestamp;double lat;double lon;float alt;float[4] q;int8_t result;",
        "vehicle_global_position:uint64_t timestamp;double lat;double lon;float alt;",
        "vehicle_attitude:uint64_t timestamp;float[4] q;",
    ];
    formats.iter().for_each(|f| log.extend(message(b'F', f.as_bytes())));
    let names = ["camera_capture", "vehicle_global_position", "vehicle_attitude"];
    for (id, name) in (0u8..).zip(names) {
        log.extend(message(b'A', &[&[0, id, 0][..], name.as_bytes()].concat()));
    }
    let q: Vec<u8> = [0.7f32, 0.0, 0.0, 0.7].iter().flat_map(|v| v.to_le_bytes()).collect();
    for i in 0..4u64 {
        let (time, lat) = ((1_000_000 * (i + 1)).to_le_bytes(), (46.0 + 1e-4 * i as f64).to_le_bytes());
        let place = [&time[..], &lat, &7f64.to_le_bytes(), &400f32.to_le_bytes()].concat();
        log.extend(message(b'D', &[&[1, 0][..], &place].concat()));
        log.extend(message(b'D', &[&[2, 0][..], &time, &q].concat()));
        log.extend(message(b'S', &[0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12]));
        log.extend(message(b'D', &[&[0, 0][..], &place, &q, &[1]].concat()));
    }
    log
}

#[test]
fn px4_logs() {
    survive(&Reader {
        name: "ulog",
        seeds: vec![ulog()],
        text: false,
        shell: None,
        memory: (256 << 10, 64),
        read: Read::File("1.ulg", &logged),
    });
}

fn logged(path: &Path) -> Verdict {
    line(log::read(path), |series| {
        let mut exposures = series.iter().flatten().flat_map(|s| &s.exposures);
        exposures.all(|e| e.fix.position.is_valid() && e.time_s.is_finite())
    })
}

#[test]
fn subtitles_of_a_film() {
    let block =
        |n: u32, at: &str, says: &str| format!("{n}\n{at} --> {at}\n<font size=\"28\">SrtCnt : {n}\n{says}</font>\n\n");
    let new = "[iso : 110] [latitude: 46.8426] [longitude: -91.9945]\n[rel_alt: 40.100 abs_alt: 198.300]";
    let old = "HOME(-91.9945,46.8426) GPS(-91.9945,\n46.8426,19)\nBAROMETER:40.1";
    let film =
        |says: &str| [block(1, "00:00:00,000", says), block(2, "00:00:00,033", says), block(3, "00:00:01,010", says)];
    in_this_thread(|| {
        survive(&Reader {
            name: "subtitles",
            seeds: [new, old].map(|says| film(says).concat().into_bytes()).into(),
            text: true,
            shell: None,
            memory: (DECODER, 64),
            // Beside frames that were taken of the film.
            read: Read::File("DJI_0001.SRT", &|path| {
                let folder = path.parent().expect("a folder").to_owned();
                let frame = folder.join("DJI_0001_00001.jpg");
                if !frame.exists() {
                    std::fs::write(&frame, encoded(ImageFormat::Jpeg)).expect("written");
                }
                let options = CardOptions { geotags: Some(path.to_owned()), ..CardOptions::default() };
                line(Card::open(&[folder], &options), |card| {
                    card.origin.is_none_or(|origin| origin.is_valid())
                        && card.pictures.iter().all(|p| p.prior.pose.center.is_finite())
                })
            }),
        });
    });
}
