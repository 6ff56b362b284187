use std::os::unix::fs::PermissionsExt;

use super::testing::identities;
use super::*;

fn mission(dir: &Path, keys: [Option<PublicKey>; 2]) -> Mission {
    let line = |key: Option<PublicKey>| key.map_or(String::new(), |k| format!("public_key = \"{k}\""));
    let text = format!(
        r#"
name = "park"
origin = {{ lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }}
camera = {{ width = 640, height = 480, fx = 385.0, fy = 385.0, cx = 320.0, cy = 240.0 }}
ground = {{ {} }}
[[aircraft]]
id = "a1"
link = "udpin:127.0.0.1:14550"
camera = {{ folder = "a1" }}
region_enu = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]
{}
"#,
        line(keys[0]),
        line(keys[1])
    );
    Mission::parse(&text, dir).expect("mission")
}

#[test]
fn a_private_key_is_made_once_and_nobody_else_may_read_it() {
    let dir = tempfile::tempdir().expect("temp dir");
    let folder = dir.path().join("keys");
    let (public, new) = make(&folder, "a1").expect("made");
    let path = private_path(&folder, "a1");
    assert_eq!(path.metadata().expect("there").mode() & 0o777, 0o600);
    assert!(new && make(&folder, "a1").expect("found") == (public, false));
    assert!(make(&folder, GROUND).expect("made").0 != public);
    // The private half does not pass for a public one.
    let text = std::fs::read_to_string(&path).expect("text");
    assert!(PublicKey::try_from(text.trim().to_owned()).is_err());
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).expect("chmod");
    assert!(make(&folder, "a1").is_err_and(|e| e.to_string().contains("chmod 600")));
}

#[test]
fn an_identity_is_refused_with_the_wrong_the_missing_or_a_garbled_key() {
    let dir = tempfile::tempdir().expect("temp dir");
    let folder = dir.path().join("keys");
    let (a1, _) = make(&folder, "a1").expect("made");
    let (ground, _) = make(&folder, GROUND).expect("made");
    let good = mission(dir.path(), [Some(ground), Some(a1)]);
    assert!(Identity::of(&good, "a1").is_ok_and(|i| i.is_signed()));
    assert!(!Identity::of(&mission(dir.path(), [None, None]), "a1").expect("unsigned").is_signed());
    let swapped = mission(dir.path(), [Some(a1), Some(ground)]);
    assert!(Identity::of(&swapped, "a1").is_err_and(|e| matches!(e, KeyError::Mismatch { .. })));
    // Zeros are what a disk leaves that lost the key, and a key that anybody has.
    let zeros = format!("{PRIVATE} {}\n", "0".repeat(64));
    for garbled in ["not a key", &zeros] {
        std::fs::write(private_path(&folder, "a1"), garbled).expect("write");
        let all_have = mission(dir.path(), [Some(ground), Some(public(&SigningKey::from_bytes(&[0; 32])))]);
        for mission in [&good, &all_have] {
            assert!(Identity::of(mission, "a1").is_err_and(|e| matches!(e, KeyError::Format(_))), "{garbled}");
        }
    }
    std::fs::remove_file(private_path(&folder, "a1")).expect("remove");
    assert!(Identity::of(&good, "a1").is_err_and(|e| e.to_string().contains("dgtr keys")));
}

#[test]
fn a_signature_holds_for_its_signer_its_kind_and_its_bytes_alone() {
    let all = identities(["a1", "a2"]);
    let [a1, ground] = [&all[0], &all[2]];
    let signature = a1.sign(Domain::Offer, b"model").expect("signed");
    let check = |who: &str, domain, bytes: &[u8]| ground.verify(who, domain, bytes, Some(&signature));
    assert_eq!(check("a1", Domain::Offer, b"model"), Ok(()));
    assert_eq!(check("a2", Domain::Offer, b"model"), Err(SignatureError::Wrong));
    assert_eq!(check("a1", Domain::Receipt, b"model"), Err(SignatureError::Wrong));
    assert_eq!(check("a1", Domain::Offer, b"other"), Err(SignatureError::Wrong));
    assert_eq!(check("a3", Domain::Offer, b"model"), Err(SignatureError::Unknown));
    assert_eq!(ground.verify("a1", Domain::Offer, b"model", None), Err(SignatureError::Missing));
}
