//! What protects the deliveries of a mission, and what does not.

use std::path::Path;

use config::link::Signing;
use config::mission::Mission;
use hal::link::LinkAddress;
use uplink::keys::{GROUND, Identity, private_path};

use super::Finding;

/// One line per kind of protection.
pub(super) fn findings(mission: &Mission) -> Vec<(&'static str, Finding)> {
    let upload = &mission.upload;
    let exposed = upload.exposed().map(|e| e.1);
    let signed = mission.check_trust();
    let mut all = vec![(
        "signatures",
        match (&signed, exposed) {
            (Err(e), _) => Finding::missing(e, "make keys with `dgtr keys`"),
            (Ok(true), _) => Finding::Ok("offers and receipts are signed by aircraft and ground".to_owned()),
            (Ok(false), None) => {
                let what = "nothing is signed: no endpoint of [upload] reaches beyond this machine";
                Finding::note(what, "before one does, `dgtr keys` makes keys")
            }
            (Ok(false), Some(endpoint)) => Finding::note(
                format!("insecure = true: whoever reaches {endpoint} can replace any model"),
                "`dgtr keys` makes keys",
            ),
        },
    )];
    if matches!(signed, Ok(true)) {
        let ids = mission.aircraft.iter().map(|a| a.id.as_str()).chain([GROUND]);
        let here: Vec<&str> = ids.filter(|id| private_path(&upload.keys, id).exists()).collect();
        if here.is_empty() {
            let what = format!("none in {}, fly and serve need their own", upload.keys.display());
            all.push(("private key", Finding::note(what, "`dgtr keys` makes them, or copy this machine's there")));
        }
        all.extend(here.into_iter().map(|id| {
            let finding = match Identity::of(mission, id) {
                Ok(_) => Finding::Ok(format!("{id}'s, readable by its owner only")),
                Err(e) => Finding::missing(e, "make it anew with `dgtr keys`"),
            };
            ("private key", finding)
        }));
    }
    let state = config::state::folder(&upload.keys);
    // Without it the folder that has to be made says the same.
    let nearest = state.ancestors().find(|p| p.exists()).unwrap_or(&state);
    let finding = match tempfile::tempfile_in(nearest) {
        Ok(_) => {
            Finding::Ok(format!("{} may be written: numbers of flights, models received, signing", state.display()))
        }
        Err(e) => {
            let what = format!(
                "{} may not be written ({e}): numbers of flights and signing would begin anew",
                state.display()
            );
            Finding::missing(what, "give the service a StateDirectory, or let it write there")
        }
    };
    all.push(("state folder", finding));
    all.extend(upload.folder.as_deref().map(|folder| ("may write", writable(folder))));
    all.extend(exposed.map(|endpoint| {
        let finding = match &upload.tls {
            _ if upload.has_tls() => {
                Finding::Ok(format!("{endpoint} by TLS; an aircraft's certificate speaks under its own id only"))
            }
            _ => Finding::note(
                format!("{endpoint} is not encrypted: models can be read on the way"),
                "write tls/ for tcp/: the keys make the certificates",
            ),
        };
        ("encryption", finding)
    }));
    all.extend(
        mission.aircraft.iter().map(|a| ("autopilot link", autopilot_link(&a.id, &a.link, &mission.link.signing))),
    );
    all
}

/// Whether models can be put into the folder that carries them, or taken out of it and answered.
fn writable(folder: &Path) -> Finding {
    let at = folder.display();
    if !folder.exists() {
        return Finding::note(
            format!("{at} is not there yet; it is made where the folder above it is writable"),
            "plug in the medium",
        );
    }
    match tempfile::tempfile_in(folder) {
        Ok(_) => Finding::Ok(format!("{at}: models are offered there")),
        Err(e) => Finding::missing(
            format!("{at} may not be written ({e}): no model is offered there"),
            "put it below /var/lib/dgtr, or give the unit ReadWritePaths= in a drop-in",
        ),
    }
}

/// Whether somebody else could speak as the autopilot of aircraft `id`.
fn autopilot_link(id: &str, link: &str, signing: &Signing) -> Finding {
    match (link.parse::<LinkAddress>(), signing) {
        (Err(e), _) => Finding::missing(format!("{id}: {e}"), "mend link of this aircraft in the mission file"),
        (Ok(_), Signing::Require) => Finding::Ok(format!("{id}: only signed MAVLink is believed")),
        (Ok(address), _) if !address.is_shared() => Finding::Ok(format!("{id}: {link} is a wire of its own")),
        (Ok(_), Signing::Off | Signing::Accept) => Finding::note(
            format!("{id}: whoever reaches {link} before the autopilot does can speak as it"),
            "set [link] signing = \"require\" and signing_key",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_for_models_that_may_not_be_written_is_missing_and_one_that_is_not_there_a_note() {
        let dir = tempfile::tempdir().expect("a folder");
        assert!(matches!(writable(dir.path()), Finding::Ok(_)));
        assert!(matches!(writable(&dir.path().join("stick")), Finding::Note(text) if text.contains("stick")));
        // No file can be made in it, whoever asks.
        assert!(matches!(writable(Path::new("/proc")), Finding::Missing(text) if text.contains("ReadWritePaths")));
    }

    #[test]
    fn signing_is_advised_where_others_could_speak_as_the_autopilot() {
        let finding = |link: &str, signing| autopilot_link("a1", link, &signing);
        assert!(matches!(finding("serial:/dev/ttyAMA0:921600", Signing::Off), Finding::Ok(_)));
        for signing in [Signing::Off, Signing::Accept] {
            assert!(matches!(finding("udpin:0.0.0.0:14550", signing), Finding::Note(text) if text.contains("signing")));
        }
        assert!(matches!(finding("udpin:0.0.0.0:14550", Signing::Require), Finding::Ok(_)));
        assert!(matches!(finding("carrier pigeon", Signing::Off), Finding::Missing(_)));
    }
}
