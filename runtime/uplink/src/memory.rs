//! Which offers are not of the ground's present session: those bound to another one, and those no newer than what an earlier one
//! has received. They come from a stick that nobody cleared, or from somebody who kept them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use disk::Disk;
use serde::{Deserialize, Serialize};

use crate::binding;
use crate::disk_error::{DiskError, io};
use crate::folder::read_not_linked;
use crate::keys::random;
use crate::offer::{Hash, Offer, Order, hex};

/// Bound on the file: a few hundred bytes for each aircraft that a mission may have.
const LIMIT: u64 = 4 << 20;
/// Bound on the name of a session.
const NAME: u64 = 64;

/// The last model of one aircraft.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Last {
    /// Whose key signed it; empty in missions without keys.
    key: String,
    flight: u64,
    counter: u64,
    /// The session that received it.
    session: String,
}

/// Why an offer is not of this session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stale {
    /// An earlier session has received this order of the aircraft.
    Received(Order),
    /// It was made for another session.
    OtherSession,
    /// It was made for none, where the mission names one.
    NoSession,
}

/// The last models of a mission's aircraft, over all sessions.
#[derive(Debug, Default)]
pub struct Memory {
    path: Option<PathBuf>,
    session: String,
    /// What this session's offers are bound to.
    number: Hash,
    /// The mission says what it is, so that every aircraft knows.
    named: bool,
    /// What earlier sessions have is taken, too.
    again: bool,
    last: Mutex<BTreeMap<String, Last>>,
    /// The disk has not taken all of it: what is noted again is written again.
    is_unwritten: Mutex<bool>,
}

impl Memory {
    /// The memory of `mission` in the folder `state`, for the session whose folder is `received`, or which the mission calls `word`.
    /// With `again` nothing counts as an earlier session's.
    ///
    /// # Errors
    /// It cannot be read back or written.
    pub fn open(
        state: &Path,
        mission: &str,
        received: &Path,
        word: Option<&str>,
        again: bool,
    ) -> Result<Self, DiskError> {
        let path = state.join(format!("{mission}.received.json"));
        let read = |p: &Path| {
            let bytes = read_not_linked(p, LIMIT).map_err(|e| e.to_string())?;
            serde_json::from_slice::<BTreeMap<String, Last>>(&bytes).map_err(|e| format!("{}: {e}", p.display()))
        };
        let newest = Disk::default().newest(&path, read).map_err(io(&path))?;
        newest.damaged.iter().for_each(|d| tracing::warn!("{d}; what earlier sessions received is not known"));
        let session = session_of(received)?;
        let number = word.map_or_else(|| binding::named(&session), binding::named);
        let (named, last) = (word.is_some(), Mutex::new(newest.found.unwrap_or_default()));
        let memory = Self { path: Some(path), session, number, named, again, last, ..Self::default() };
        // Better now than after the first model.
        memory.write()?;
        Ok(memory)
    }

    /// Of a session that nothing is remembered for.
    ///
    /// # Errors
    /// The system has no random numbers.
    pub fn forgetful(word: Option<&str>, again: bool) -> std::io::Result<Self> {
        let number = word.map_or_else(random, |word| Ok(binding::named(word)))?;
        Ok(Self { number, named: word.is_some(), again, ..Self::default() })
    }

    /// What offers of this session are bound to.
    pub fn session(&self) -> &Hash {
        &self.number
    }

    /// Why an offer is not of this session.
    pub fn is_stale(&self, offer: &Offer, key: &str) -> Option<Stale> {
        if self.again {
            return None;
        }
        match offer.session {
            Some(session) if session != self.number => return Some(Stale::OtherSession),
            None if self.named => return Some(Stale::NoSession),
            _ => {}
        }
        let last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let last = last.get(&offer.aircraft).filter(|l| l.key == key && l.session != self.session)?;
        let order = Order { flight: last.flight, counter: last.counter };
        (offer.order <= order).then_some(Stale::Received(order))
    }

    /// Remembers a model that is here.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn note(&self, offer: &Offer, key: &str) -> Result<(), DiskError> {
        let Order { flight, counter } = offer.order;
        let now = Last { key: key.into(), flight, counter, session: self.session.clone() };
        {
            let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
            let before = last.insert(offer.aircraft.clone(), now.clone());
            if before == Some(now) && !*self.is_unwritten.lock().unwrap_or_else(PoisonError::into_inner) {
                return Ok(());
            }
        }
        self.write()
    }

    fn write(&self) -> Result<(), DiskError> {
        let Some(path) = &self.path else { return Ok(()) };
        // One after the other, so that nothing older is written last.
        let mut is_unwritten = self.is_unwritten.lock().unwrap_or_else(PoisonError::into_inner);
        *is_unwritten = true;
        let json = {
            let last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
            serde_json::to_vec(&*last).map_err(|e| io(path)(e.into()))?
        };
        Disk::default().replace_keeping(path, |out| out.write_all(&json)).map_err(|e| io(path)(e.into()))?;
        *is_unwritten = false;
        Ok(())
    }
}

/// The name of the session that has `received`: made with it, and the same after a restart.
fn session_of(received: &Path) -> Result<String, DiskError> {
    let path = received.join("session");
    let there = read_not_linked(&path, NAME).ok().and_then(|bytes| String::from_utf8(bytes).ok());
    if let Some(name) = there.filter(|name| name.len() as u64 == NAME) {
        return Ok(name);
    }
    let name = hex(&random().map_err(io(&path))?);
    Disk::default().replace(&path, |out| out.write_all(name.as_bytes())).map_err(|e| io(&path)(e.into()))?;
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offer::testing::offer;

    #[test]
    fn what_an_earlier_session_received_is_stale_in_a_later_one_and_not_in_its_own() {
        let dir = tempfile::tempdir().expect("a folder");
        let open = |session: &str, again| {
            Memory::open(dir.path(), "m", &dir.path().join(session), None, again).expect("opens")
        };
        let (second, third) = (offer("m", "a1", 2), offer("m", "a1", 3));
        open("yesterday", false).note(&second, "k").expect("written");
        assert_eq!(open("yesterday", false).is_stale(&second, "k"), None, "the same session, started again");
        let today = open("today", false);
        assert_eq!(today.is_stale(&second, "k"), Some(Stale::Received(second.order)));
        assert_eq!(today.is_stale(&offer("m", "a1", 1), "k"), Some(Stale::Received(second.order)));
        assert_eq!(today.is_stale(&third, "k"), None);
        assert_eq!(today.is_stale(&second, "another key"), None, "numbers begin anew with a key");
        assert_eq!(today.is_stale(&offer("m", "a2", 1), "k"), None);
        assert_eq!(open("today", true).is_stale(&second, "k"), None, "asked for");
    }

    /// A receipt would say that nothing can be lost any more.
    #[test]
    fn what_found_no_room_is_written_when_it_is_noted_again() {
        let dir = tempfile::tempdir().expect("a folder");
        let state = dir.path().join("state");
        let open = |session: &str| {
            std::fs::create_dir_all(&state).expect("made");
            Memory::open(&state, "m", &dir.path().join(session), None, false).expect("opens")
        };
        let (today, model) = (open("today"), offer("m", "a1", 2));
        // In the place of its folder lies something else.
        std::fs::remove_dir_all(&state).expect("removed");
        std::fs::write(&state, b"").expect("written");
        assert!((0..2).all(|_| today.note(&model, "k").is_err()));
        std::fs::remove_file(&state).expect("removed");
        today.note(&model, "k").expect("written");
        assert_eq!(open("tomorrow").is_stale(&model, "k"), Some(Stale::Received(model.order)));
    }

    #[test]
    fn an_offer_for_another_session_is_stale_however_new_its_number_and_whatever_is_remembered() {
        let dir = tempfile::tempdir().expect("a folder");
        let open = |session: &str, word: Option<&str>, again| {
            let state = dir.path().join(format!("state of {session}"));
            std::fs::create_dir_all(&state).expect("made");
            Memory::open(&state, "m", &dir.path().join(session), word, again).expect("opens")
        };
        let nobody = crate::keys::Identity::unsigned();
        let (yesterday, today) = (open("yesterday", None, false), open("today", None, false));
        assert_eq!(yesterday.session(), open("yesterday", None, false).session(), "the same after a restart");
        let unbound = offer("m", "a1", 2);
        let old = offer("m", "a1", u64::MAX).bound_to(yesterday.session(), &nobody);
        assert_eq!(today.is_stale(&old, "k"), Some(Stale::OtherSession));
        assert_eq!(today.is_stale(&unbound.bound_to(today.session(), &nobody), "k"), None);
        assert_eq!(today.is_stale(&unbound, "k"), None, "the aircraft could not know");
        assert_eq!(open("today", None, true).is_stale(&old, "k"), None, "asked for");
        // One that the mission names is the same on every ground, and no aircraft can miss it.
        let named = open("today", Some("monday"), false);
        assert_eq!(named.is_stale(&unbound, "k"), Some(Stale::NoSession));
        assert_eq!(named.session(), open("elsewhere", Some("monday"), false).session());
        assert_eq!(named.is_stale(&unbound.bound_to(&binding::named("monday"), &nobody), "k"), None);
    }
}
