use super::*;

fn read_text(text: &str) -> Result<Vec<(String, Geotag)>, FormatError> {
    read_whole(text).map(|found| found.tags)
}

fn read_whole(text: &str) -> Result<Geotags, FormatError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("geo.txt");
    std::fs::write(&path, text).unwrap();
    read(&path)
}

#[test]
fn geo_txt_mission_planner_and_our_own_csv_say_the_same() {
    let position = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 198.3 };
    let ours = "picture,sequence,lat_deg,lon_deg,alt_m,east_m,north_m,up_m,qw,qx,qy,qz,sigma_m,sigma_deg,speed_m_s,key_frame\n\
                IMG_1.png,1,46.8426,-91.9945,198.3,0,0,0,0,1,0,0,0.8,2,5,1\n";
    let planner =
        "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\nIMG_1.JPG 46.8426 -91.9945 198.3 90 0 0 0\n";
    let odm = "EPSG:4326\nIMG_1.JPG -91.9945 46.8426 198.3 90 0 0 0.8 1.5\n";
    for (text, sigma) in [(ours, [0.8, 0.8]), (planner, [3.0, 3.0]), (odm, [0.8, 1.5])] {
        let (name, tag) = read_text(text).unwrap().remove(0);
        assert!(name.starts_with("img_1."), "{name}");
        assert_eq!((tag.fix.position, tag.fix.sigma_m), (position, sigma), "{text}");
        assert!((tag.attitude.unwrap().rotation * glam::DVec3::Z).z < -0.999, "{text}");
    }
}

#[test]
fn tables_of_other_programs_are_read_whatever_they_call_their_columns() {
    let position = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 198.3 };
    for text in [
        "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll\nDJI 1.JPG,-91.9945,46.8426,198.3,+45.00,0,0\n",
        "# CoordinateSystem: WGS 84 (EPSG::4326)\n#Label,X/Longitude,Y/Latitude,Z/Altitude\nDJI 1.JPG,-91.9945,46.8426,198.3\n",
        "#name,x,y,alt,yaw,pitch,roll\nDJI 1.JPG,-91.9945,46.8426,198.3,+45.00,0,0\n",
        "\u{feff}imagename;latitude;longitude;altitude\r\nDJI 1.JPG;46,8426;-91,9945;198,3\r\n",
        "EPSG: 4326\nDJI 1.JPG -91.9945 46.8426 198.3\n",
        "WGS84\nDJI 1.JPG\t-91.9945\t46.8426\t198.3\n",
    ] {
        let tags = read_text(text).unwrap();
        assert_eq!((tags[0].0.as_str(), tags[0].1.fix.position, tags.len()), ("dji 1.jpg", position, 1), "{text}");
    }
    if cfg!(not(feature = "epsg")) {
        return;
    }
    let polish = read_text("EPSG:2180\na.jpg 340607 548220 100\n").unwrap()[0].1.fix.position;
    assert!((52.0..54.0).contains(&polish.lat_deg) && (16.0..18.0).contains(&polish.lon_deg), "{polish:?}");
}

#[test]
fn a_pitch_of_minus_ninety_looks_down_and_a_missing_height_is_not_zero() {
    for pitch in ["-90", "0"] {
        let tag = read_text(&format!("EPSG:4326\na.jpg 7 46 400 45 {pitch} 0\n")).unwrap()[0].1;
        assert!((tag.attitude.unwrap().rotation * glam::DVec3::Z).z < -0.999, "{pitch}");
    }
    let tag = read_text("EPSG:4326\na.jpg 7 46\n").unwrap()[0].1;
    assert!(!tag.has_height && tag.fix.sigma_m[1] >= UNKNOWN_HEIGHT_SIGMA_M);
}

#[test]
fn lines_that_make_no_sense_are_named_by_number() {
    for (text, expected) in [
        ("", "is empty"),
        ("hello world\n", "names columns"),
        ("EPSG:1\na 1 2 3\n", "EPSG:1 is not known"),
        ("a.jpg 7.5 46.2 400\n", "names columns"),
        ("name,x,y,z\na.jpg,576700,5188100,198\n", "EPSG:CODE"),
        ("EPSG:4326\na.jpg 200 95 3\n", "line 2"),
        ("EPSG:4326\na.jpg x 95 3\n", "\"x\" is not a number"),
        ("name,lat,lon\na.jpg,1\n", "line 2: has no position"),
        ("name,lat,lon,qw,qx,qy,qz\na.jpg,1,2,0,0,0,0\n", "not a rotation"),
        ("imageIndex: 1 Date:2020/2/1 lat/lon: 46.8,-91.9\n", "it names no picture"),
        ("name,lat,alt\na.jpg,1,2\n", "it names no longitude"),
        ("name,easting,northing\na.jpg,12.5,40.25\n", "names no zone"),
        ("EPSG:4326\nname,easting,northing\na.jpg,12.5,40.25\n", "in degrees"),
        ("EPSG:32615\nname,lon,lat\na.jpg,-91.9,46.8\n", "in metres"),
        ("name,east,north,zone\na.jpg,576700,5188100,77\n", "\"77\" is no UTM zone"),
        ("name,lat,lon,alt\na.jpg,46,84,-91,99,198\n", "has 6 cells where 4 are named"),
        ("a.jpg,46.8,-91.9,198,1\n", "names columns"),
        ("name,lat,lon\na.jpg,46 deg 61' 0\" N,7\n", "is not a number"),
        ("name,lat,lon\na.jpg,46 deg 1' 0\" E,7\n", "is not a number"),
    ] {
        let error = read_text(text).unwrap_err().to_string();
        assert!(error.contains(expected) && !error.contains('\n'), "{text:?}: {error}");
    }
}

#[test]
fn tables_as_programs_and_spreadsheets_write_them_say_the_same_in_any_order_of_columns() {
    let position = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 198.3 };
    for text in [
        "SourceFile,ImageWidth,FileSize,LongExposureNoiseReduction,GPSLatitudeRef,DateTimeOriginal,GPSLatitude,GPSLongitude,GPSAltitude\nDCIM/DJI_1.JPG,4000,3 MB,Off,North,2016:06:23 16:31:59,46.8426,-91.9945,198.3\n",
        "SourceFile,GPSAltitude,GPSLatitude,GPSLongitude\nDCIM/DJI_1.JPG,198.3 m Above Sea Level,\"46 deg 50' 33.36\"\" N\",\"91 deg 59' 40.20\"\" W\"\n",
        "SourceFile,GPSLongitude,GPSLongitudeRef,GPSLatitude,GPSAltitude\nDCIM/DJI_1.JPG,91.9945,West,46.8426,198.3\nDCIM/DJI_2.JPG,,,,\n",
        "Bild;Breite;Laenge;Hoehe\r\nDJI_1.JPG;46,8426;-91,9945;198,3\r\n",
        "H\u{f6}he;L\u{e4}nge;Breite;Dateiname\n198,3;-91,9945;46,8426;DJI_1.JPG\n",
        "# CoordinateSystem: GEOGCS[\"WGS 84\",DATUM[\"World Geodetic System 1984\",SPHEROID[\"WGS 84\",6378137,298.257223563,AUTHORITY[\"EPSG\",\"7030\"]],AUTHORITY[\"EPSG\",\"6326\"]],UNIT[\"degree\",0.01745,AUTHORITY[\"EPSG\",\"9102\"]],AUTHORITY[\"EPSG\",\"4326\"]]\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll\nDJI_1.JPG,-91.9945,46.8426,198.3,46.00,0,0\n",
        "# CoordinateSystem: GEOGCS[\"WGS 84\",DATUM[\"World Geodetic System 1984\"]]\n#Label,X/Longitude,Y/Latitude,Z/Altitude\nDJI_1,-91.9945,46.8426,198.3\n",
        "DJI_1.JPG,46.8426,-91.9945,198.3,5.0,10.0\n",
        "DJI_1.JPG;46,8426;-91,9945;198,3\n",
        "alt [m];lat [deg];lon [deg];photo\n198.3;46.8426;-91.9945;DJI_1.JPG\n",
    ] {
        let tags = read_text(text).unwrap_or_else(|e| panic!("{text}: {e}"));
        let near = |p: Geodetic| {
            (p.lat_deg - position.lat_deg).abs() < 1e-9
                && (p.lon_deg - position.lon_deg).abs() < 1e-9
                && p.alt_m == position.alt_m
        };
        assert!(tags.len() == 1 && tags[0].0.contains("dji_1") && near(tags[0].1.fix.position), "{text}: {tags:?}");
    }
}

#[test]
fn a_list_without_names_is_read_as_pix4ds_with_its_accuracies_and_says_so() {
    let found = read_whole("DJI_1.JPG,46.8426,-91.9945,198.3,5.0,10.0\n").unwrap();
    assert_eq!(found.tags[0].1.fix.sigma_m, [5.0, 10.0]);
    assert!(found.doubt.is_some_and(|d| d.contains("latitude, longitude, altitude")));
    assert!(read_whole("EPSG:4326\nDJI_1.JPG -91.9945 46.8426\n").unwrap().doubt.is_none());
}

#[test]
fn easting_and_northing_are_placed_by_a_line_or_a_column_that_states_the_zone() {
    for text in [
        "EPSG:32615\nname,easting,northing,alt\na.jpg,576689.183,5188174.180,158.5\n",
        "# CoordinateSystem: WGS 84 / UTM zone 15N\n#Label,X/Easting,Y/Northing,Z/Altitude\na.jpg,576689.183,5188174.180,158.5\n",
        "Bild;Rechtswert;Hochwert;H\u{f6}he;Zone\na.jpg;576689,183;5188174,180;158,5;15N\n",
        "name,UTM Zone,Northing,Easting\na.jpg,15T,5188174.180,576689.183\n",
    ] {
        let p = read_text(text).unwrap_or_else(|e| panic!("{text}: {e}"))[0].1.fix.position;
        assert!((p.lat_deg - 46.842_690_67).abs() < 1e-7 && (p.lon_deg + 91.994_216_22).abs() < 1e-7, "{text}: {p:?}");
    }
}

#[test]
fn a_hemisphere_stands_in_a_column_of_any_such_name_or_in_the_next_one() {
    for text in [
        "name,lat,lat_ref,lon,lon_ref,alt\na.jpg,33.5,S,70.5,W,500.5\n",
        "name,latitude,N/S,longitude,E/W\na.jpg,33.5,S,70.5,W\n",
        "name,lat,,lon,\na.jpg,33.5,s,70.5,w\n",
        "file;latitude;lat hemisphere;longitude;lon hemisphere\na.jpg;33,5;South;70,5;West\n",
    ] {
        let p = read_text(text).unwrap_or_else(|e| panic!("{text}: {e}"))[0].1.fix.position;
        assert_eq!((p.lat_deg, p.lon_deg), (-33.5, -70.5), "{text}");
    }
    for text in ["name,lat,latref,lon,lonref\na.jpg,33.5,W,70.5,W\n", "name,lat,lon,lonref\na.jpg,33.5,70.5,Ouest\n"] {
        let error = read_text(text).unwrap_err().to_string();
        assert!(error.contains("is no hemisphere"), "{text}: {error}");
    }
}

#[test]
fn heights_in_feet_are_told_by_their_column_and_heights_above_the_ground_are_none() {
    let alt = |column: &str| read_text(&format!("name,lat,lon,{column}\na.jpg,46.5,7.5,1000\n")).unwrap()[0].1;
    for feet in ["altitude (ft)", "alt_feet", "altitude_above_seaLevel(feet)"] {
        let found = alt(feet);
        assert!((found.fix.position.alt_m - 304.8).abs() < 1e-9 && found.has_height, "{feet}: {found:?}");
    }
    for relative in ["altitude above ground", "height_above_takeoff(feet)"] {
        assert!(!alt(relative).has_height, "{relative}");
    }
}

#[test]
fn a_picture_that_is_named_twice_counts_once_where_both_lines_agree_and_not_at_all_where_they_do_not() {
    let found = read_whole("EPSG:4326\na.jpg 7.5 46.5\nA.JPG 7.5 46.5\nb.jpg 7.5 46.5\nb.jpg 7.6 46.5\n").unwrap();
    let names: Vec<&str> = found.tags.iter().map(|t| t.0.as_str()).collect();
    assert_eq!(names, ["a.jpg"]);
    assert!(found.doubt.as_ref().is_some_and(|d| d.contains("1 named twice") && d.contains("b.jpg")), "{found:?}");
}

#[test]
fn decimal_commas_between_commas_that_fill_the_named_cells_are_refused() {
    for text in [
        "name,lat,lon,alt,yaw,pitch,roll\na.jpg,46,8,7,5,198,3\n",
        "name,lat,lon,alt,yaw\na.jpg,46,8,7,5\nb.jpg,46,9,7,5\n",
    ] {
        let error = read_text(text).unwrap_err().to_string();
        assert!(error.contains("whole degrees") && !error.contains('\n'), "{text}: {error}");
    }
}

#[test]
fn a_place_of_zeros_is_none() {
    let found = read_text("name,lat,lon,alt\na.jpg,0.0,0.0,0.0\nb.jpg,46.5,7.5,400\n").unwrap();
    assert_eq!(found.iter().map(|t| t.0.as_str()).collect::<Vec<_>>(), ["b.jpg"]);
}

#[test]
fn what_is_not_certain_is_said() {
    let doubt = |text: &str| read_whole(text).unwrap().doubt.unwrap_or_default();
    assert!(doubt("name,x,y\na.jpg,12.5,40.25\n").contains("longitude and latitude"));
    assert!(doubt("name,east,north,zone\na.jpg,384000,3768000,11S\n").contains("south of the equator"));
    assert_eq!(doubt("name,east,north,zone\na.jpg,384000,3768000,11N\n"), "");
}

#[test]
fn accuracies_that_no_receiver_has_are_not_believed() {
    for (stated, believed) in [("1e-300", 0.01), ("1e300", 1000.0), ("0", GPS_SIGMA_M)] {
        let text = format!("EPSG:4326\na.jpg 7.5 46.5 400 0 0 0 {stated} {stated}\n");
        assert_eq!(read_text(&text).unwrap()[0].1.fix.sigma_m, [believed; 2], "{stated}");
    }
}
