//! Who is in trouble while the others still fly: silent, low on battery, without its autopilot, landed short of its region. Each
//! is named once, with what to do, and once more when it is over.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use config::mission::Mission;
use uplink::heartbeat::Condition;
use uplink::receive::LastHeard;

/// An aircraft that covered less of its region than this did not do what it was to do, percent.
pub const COVERED_PCT: u32 = 75;

/// Without a network only new models are signs of life: they come that many times as rarely as they may.
const RARELY: f64 = 4.0;
/// What is over for so long is said to be over: a link that flaps fills no page.
const CALM: Duration = Duration::from_secs(10);

/// What an aircraft is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trouble {
    Silent,
    BatteryLow,
    LinkLost,
    LandedShort,
}

impl Trouble {
    const ALL: [Self; 4] = [Self::Silent, Self::BatteryLow, Self::LinkLost, Self::LandedShort];

    /// For the page.
    fn state(self) -> &'static str {
        match self {
            Self::Silent => "silent",
            Self::BatteryLow => "its battery is low",
            Self::LinkLost => "its computer hears no autopilot",
            Self::LandedShort => "landed, ground was left",
        }
    }
}

/// What is known of one aircraft's trouble.
#[derive(Clone, Copy, Debug, Default)]
struct Standing {
    told: bool,
    /// Since when it is over.
    over: Option<Instant>,
}

/// Watches the aircraft of a mission.
pub(super) struct Watchdog {
    ids: Vec<String>,
    out: PathBuf,
    silence: Duration,
    /// Until an aircraft without a network counts as silent; `None`: nobody knows when it is heard next.
    rare: Option<Duration>,
    /// Aircraft are expected to be heard while they fly.
    has_network: bool,
    /// When the first of all was heard.
    first: Option<Instant>,
    standing: Vec<[Standing; Trouble::ALL.len()]>,
    state: Vec<Option<&'static str>>,
}

impl Watchdog {
    pub(super) fn new(mission: &Mission, out: &Path) -> Self {
        let ids: Vec<String> = mission.aircraft.iter().map(|a| a.id.clone()).collect();
        let (silence_s, checkpoint_s) = (mission.ground.silence_s, mission.upload.checkpoint_s);
        Self {
            out: out.into(),
            silence: Duration::from_secs_f64(silence_s),
            rare: (checkpoint_s > 0.0).then(|| Duration::from_secs_f64(silence_s + RARELY * checkpoint_s)),
            has_network: !mission.upload.listen.is_empty(),
            first: None,
            standing: vec![Default::default(); ids.len()],
            state: vec![None; ids.len()],
            ids,
        }
    }

    /// What troubles an aircraft most, for the page.
    pub(super) fn state(&self, i: usize) -> Option<&'static str> {
        self.state[i]
    }

    /// Looks at aircraft `i`, whose last model is here if `finished`, and of whose region the models here cover so much; what is to be
    /// said now.
    pub(super) fn look(
        &mut self,
        i: usize,
        heard: &LastHeard,
        finished: bool,
        covered_pct: Option<u32>,
        now: Instant,
    ) -> Vec<String> {
        if let Some(ago) = heard.ago {
            let at = now.checked_sub(ago).unwrap_or(now);
            self.first = Some(self.first.map_or(at, |first| first.min(at)));
        }
        let condition = heard.condition.unwrap_or_default();
        let covered = covered_pct.max(condition.covered_pct.map(u32::from));
        let mut said = Vec::new();
        self.state[i] = None;
        for (k, trouble) in Trouble::ALL.into_iter().enumerate().rev() {
            // Of an aircraft whose last model is here the model tells.
            let stands = !finished && self.stands(trouble, heard, &condition, covered, now);
            if stands {
                self.state[i] = Some(trouble.state());
            }
            let standing = &mut self.standing[i][k];
            if stands {
                standing.over = None;
                if !std::mem::replace(&mut standing.told, true) {
                    said.push(self.line(i, trouble, heard, covered));
                }
            } else if standing.told && (finished || now.duration_since(*standing.over.get_or_insert(now)) >= CALM) {
                *standing = Standing::default();
                said.extend(self.over(i, trouble, finished));
            }
        }
        said
    }

    fn stands(
        &self,
        trouble: Trouble,
        heard: &LastHeard,
        condition: &Condition,
        covered: Option<u32>,
        now: Instant,
    ) -> bool {
        match (trouble, heard.ago) {
            // It never took off, or its link never came up.
            (Trouble::Silent, None) => {
                self.has_network && self.first.is_some_and(|first| now.duration_since(first) > self.silence)
            }
            (Trouble::Silent, Some(ago)) if heard.condition.is_some() => ago > self.silence,
            (Trouble::Silent, Some(ago)) => self.rare.is_some_and(|rare| ago > rare),
            (Trouble::BatteryLow, _) => condition.battery_low,
            (Trouble::LinkLost, _) => condition.link_lost,
            (Trouble::LandedShort, _) => condition.landed && covered.is_some_and(|percent| percent < COVERED_PCT),
        }
    }

    fn line(&self, i: usize, trouble: Trouble, heard: &LastHeard, covered: Option<u32>) -> String {
        let id = &self.ids[i];
        let charge = heard
            .condition
            .and_then(|condition| condition.battery_pct)
            .map_or(String::new(), |pct| format!(" ({pct} %)"));
        let what = match (trouble, heard.ago) {
            (Trouble::Silent, None) => {
                format!("nothing is heard of {id}, {:.0} s after another one was", self.silence.as_secs_f64())
            }
            (Trouble::Silent, Some(ago)) => format!("{id} has not been heard of for {:.0} s", ago.as_secs_f64()),
            (Trouble::BatteryLow, _) => format!("the battery of {id} is low{charge}"),
            (Trouble::LinkLost, _) => format!("the computer of {id} does not hear its autopilot"),
            (Trouble::LandedShort, _) => format!("{id} has landed and left ground"),
        };
        let share = covered.map_or(String::new(), |percent| format!("; {percent} % of its region is covered"));
        let deal = match self.ids.len() {
            1 => String::new(),
            _ => format!(
                "; if it does not go on, `dgtr survey --after {} --without {id}` deals the rest to the others",
                self.out.display()
            ),
        };
        format!("{what}{share}{deal}")
    }

    fn over(&self, i: usize, trouble: Trouble, finished: bool) -> Option<String> {
        let id = &self.ids[i];
        match trouble {
            Trouble::Silent => Some(format!("{id} is heard of again")),
            Trouble::BatteryLow if !finished => Some(format!("the battery of {id} is good again")),
            Trouble::LinkLost if !finished => Some(format!("the computer of {id} hears its autopilot again")),
            Trouble::LandedShort if !finished => Some(format!("{id} goes on")),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::mission;
    use super::*;

    const OUT: &str = "ground";

    fn watchdog(network: bool) -> Watchdog {
        let folder = tempfile::tempdir().expect("temp dir");
        let mut mission = mission(folder.path());
        if network {
            mission.upload.listen = vec!["tcp/127.0.0.1:7447".into()];
        }
        Watchdog::new(&mission, Path::new(OUT))
    }

    fn heard(ago_s: f64, condition: Condition) -> LastHeard {
        LastHeard { ago: Some(Duration::from_secs_f64(ago_s)), condition: Some(condition) }
    }

    #[test]
    fn who_falls_silent_is_named_once_with_what_to_do_and_once_more_when_it_is_heard_again() {
        let (mut watchdog, start) = (watchdog(true), Instant::now());
        let at = |s: u64| start + Duration::from_secs(s);
        assert!(watchdog.look(0, &heard(2.0, Condition::default()), false, Some(48), at(5)).is_empty());
        assert!(watchdog.look(0, &heard(59.0, Condition::default()), false, Some(48), at(62)).is_empty());
        let said = watchdog.look(0, &heard(61.0, Condition::default()), false, Some(48), at(64));
        let wanted = "west has not been heard of for 61 s; 48 % of its region is covered; if it does not go on, \
                      `dgtr survey --after ground --without west` deals the rest to the others";
        assert_eq!((said, watchdog.state(0)), (vec![wanted.to_owned()], Some("silent")));
        assert!(watchdog.look(0, &heard(300.0, Condition::default()), false, Some(48), at(303)).is_empty(), "once");
        // It flaps for less than ten seconds, then it is back.
        assert!(watchdog.look(0, &heard(1.0, Condition::default()), false, Some(48), at(310)).is_empty());
        assert!(watchdog.look(0, &heard(61.0, Condition::default()), false, Some(48), at(312)).is_empty());
        assert!(watchdog.look(0, &heard(1.0, Condition::default()), false, Some(48), at(320)).is_empty());
        let said = watchdog.look(0, &heard(1.0, Condition::default()), false, Some(48), at(330));
        assert_eq!((said, watchdog.state(0)), (vec!["west is heard of again".to_owned()], None));
        assert_eq!(
            watchdog.look(0, &heard(70.0, Condition::default()), false, None, at(400)).len(),
            1,
            "a second time"
        );
    }

    #[test]
    fn who_is_never_heard_is_named_where_a_network_leads_and_not_where_models_come_on_a_stick() {
        for (network, named) in [(true, 1), (false, 0)] {
            let (mut watchdog, start) = (watchdog(network), Instant::now());
            watchdog.look(1, &heard(0.0, Condition::default()), false, None, start);
            assert!(watchdog.look(0, &LastHeard::default(), false, None, start + Duration::from_secs(50)).is_empty());
            let said = watchdog.look(0, &LastHeard::default(), false, None, start + Duration::from_secs(61));
            assert_eq!(said.len(), named, "{said:?}");
            assert!(said.iter().all(|line| line.starts_with("nothing is heard of west, 60 s after another one")));
        }
    }

    #[test]
    fn a_low_battery_a_lost_autopilot_and_a_landing_short_of_the_region_are_named_each_once() {
        let (mut watchdog, now) = (watchdog(true), Instant::now());
        let low = Condition { battery_pct: Some(14), battery_low: true, covered_pct: Some(40), ..Condition::default() };
        let said = watchdog.look(0, &heard(1.0, low), false, None, now);
        assert!(said[0].starts_with("the battery of west is low (14 %); 40 % of its region is covered"), "{said:?}");
        let lost = Condition { link_lost: true, ..low };
        let said = watchdog.look(0, &heard(1.0, lost), false, None, now);
        assert!(said.len() == 1 && said[0].starts_with("the computer of west does not hear"), "{said:?}");
        let landed = Condition { landed: true, battery_low: true, covered_pct: Some(52), ..Condition::default() };
        let said = watchdog.look(0, &heard(1.0, landed), false, Some(30), now);
        assert!(said.len() == 1 && said[0].starts_with("west has landed and left ground; 52 %"), "{said:?}");
        let whole = Condition { covered_pct: Some(99), ..landed };
        assert!(watchdog.look(1, &heard(1.0, Condition { battery_low: false, ..whole }), false, None, now).is_empty());
        // The last model is here: that tells.
        assert!(watchdog.look(0, &heard(500.0, landed), true, Some(52), now).is_empty());
        assert_eq!(watchdog.state(0), None);
    }
}
