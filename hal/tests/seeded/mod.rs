//! Vehicles, cameras and links by chance, the same ones for the same seed.

mod chance;

pub use chance::Chance;
use chance::Rhythm;
use glam::DVec3;
use hal::mavlink::dialect::{CAMERA_FEEDBACK_DATA, CAMERA_IMAGE_CAPTURED_DATA, MavBool};
use hal::traits::PictureClues;
use hal::vehicle::VehicleSettings;

use crate::sortie::{SECOND, Sortie, boot_ms, on_earth, settings, unix_us};

/// The camera's clock is ahead of the computer's by this, s.
const CAMERA_AHEAD_S: f64 = 7777.3;
/// When the first exposure is.
const BEGIN_S: f64 = 10.0;
/// Every aircraft flies straight on, so that a place is a time.
pub const SPEED_M_S: f64 = 10.0;

/// When the shutter of another camera opens.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Other {
    /// With ours.
    Together,
    /// By a rhythm of its own.
    Alone,
    /// As often as ours and so much later: an intervalometer that was started later.
    Shifted(f64),
}

/// What announces an exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
enum By {
    /// ArduPilot's CAMERA_FEEDBACK with Unix time.
    Feedback,
    /// PX4's CAMERA_IMAGE_CAPTURED with boot time; this is its result.
    Captured(u8),
}

/// What is missing at the ends of a flight, so that all of it fits one exposure earlier or later as well as where it belongs, or better.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Cut {
    FirstAnnouncement,
    LastAnnouncement,
    FirstPicture,
    LastPicture,
    FirstAnnouncementAndLastPicture,
    FirstPictureAndLastAnnouncement,
}

impl Cut {
    const ALL: [Self; 6] = [
        Self::FirstAnnouncement,
        Self::LastAnnouncement,
        Self::FirstPicture,
        Self::LastPicture,
        Self::FirstAnnouncementAndLastPicture,
        Self::FirstPictureAndLastAnnouncement,
    ];

    fn is_unheard(self, is_first: bool, is_last: bool) -> bool {
        match self {
            Self::FirstAnnouncement | Self::FirstAnnouncementAndLastPicture => is_first,
            Self::LastAnnouncement | Self::FirstPictureAndLastAnnouncement => is_last,
            Self::FirstPicture | Self::LastPicture => false,
        }
    }

    fn is_untaken(self, is_first: bool, is_last: bool) -> bool {
        match self {
            Self::FirstPicture | Self::FirstPictureAndLastAnnouncement => is_first,
            Self::LastPicture | Self::FirstAnnouncementAndLastPicture => is_last,
            Self::FirstAnnouncement | Self::LastAnnouncement => false,
        }
    }
}

/// What vehicles, link and cameras of a flight are like. Times in seconds, shares 0 … 1.
#[derive(Debug)]
pub struct Conditions {
    interval: f64,
    latency: f64,
    jitter: f64,
    exposures: usize,
    lost: f64,
    lost_pictures: f64,
    reordered: f64,
    doubled: f64,
    announced_after: f64,
    numbered: bool,
    camera_clock: bool,
    /// Always the same interval: nothing tells one exposure from the next but the flight's ends.
    regular: bool,
    not_taken: f64,
    /// Exposures of one survey line.
    line: usize,
    by: By,
    /// Cameras beside ours, and the place of ours among them.
    others: Vec<Other>,
    ours: u8,
    /// The mission names it.
    named: bool,
    /// Aircraft on the same link, and which of them is ours.
    vehicles: u8,
    system: u8,
    /// An end of the flight that does not tell.
    cut: Option<Cut>,
}

impl Conditions {
    pub fn by_chance(chance: &mut Chance) -> Self {
        let interval = chance.between(0.3, 3.0);
        let cameras = chance.count(1, 3);
        let vehicles = chance.count(1, 3) as u8;
        let other = |chance: &mut Chance| match chance.count(0, 4) {
            0 | 1 => Other::Together,
            2 | 3 => Other::Alone,
            _ => Other::Shifted(interval * chance.between(0.2, 0.8)),
        };
        Self {
            interval,
            latency: chance.between(0.0, 4.0),
            jitter: chance.between(0.01, 0.08),
            exposures: chance.count(15, 69),
            lost: chance.sometimes(0.5, 0.2),
            lost_pictures: chance.sometimes(0.5, 0.2),
            reordered: chance.sometimes(0.5, 0.2),
            doubled: chance.sometimes(0.5, 0.2),
            announced_after: if chance.yes(0.5) { chance.between(0.0, 0.2) } else { chance.between(0.0, 4.0) },
            numbered: chance.yes(0.7),
            camera_clock: chance.yes(0.4),
            regular: chance.yes(0.3),
            not_taken: chance.sometimes(0.7, 0.1),
            line: chance.count(4, 11),
            by: match chance.count(0, 3) {
                0 => By::Captured([1, 0xFF][chance.count(0, 1)]),
                _ => By::Feedback,
            },
            others: (1..cameras).map(|_| other(chance)).collect(),
            ours: chance.count(0, cameras - 1) as u8,
            named: chance.yes(0.5),
            vehicles,
            system: chance.count(1, vehicles.into()) as u8,
            cut: None,
        }
    }

    /// A flight that two assignments explain equally well: one camera of an even rhythm, whose latency nobody knows, and an end cut.
    pub fn ambiguous(chance: &mut Chance) -> Self {
        let conditions = Self::by_chance(chance);
        let cut = Cut::ALL[chance.count(0, Cut::ALL.len() - 1)];
        Self {
            // The shifted latency is a possible one, too.
            latency: chance.between(conditions.interval, 4.0),
            jitter: 0.02,
            lost: 0.0,
            lost_pictures: 0.0,
            not_taken: 0.0,
            regular: true,
            others: Vec::new(),
            ours: 0,
            cut: Some(cut),
            ..conditions
        }
    }

    /// The rhythm allows one answer: exposures are not evenly spaced, and no other camera has the same rhythm unless the mission names
    /// ours.
    pub fn tells(&self) -> bool {
        let shifted = self.others.iter().any(|other| matches!(other, Other::Shifted(_)));
        !self.regular && (self.named || !shifted)
    }

    /// Both ends are cut, so that as many pictures as announcements are left: one exposure off, they fit without a gap.
    pub fn looks_whole(&self) -> bool {
        matches!(self.cut, Some(Cut::FirstAnnouncementAndLastPicture | Cut::FirstPictureAndLastAnnouncement))
    }

    /// Nothing waits until it is known which camera is ours.
    pub fn knows_its_camera(&self) -> bool {
        self.named || self.others.is_empty()
    }

    pub fn settings(&self) -> VehicleSettings {
        let mut settings = settings(self.system);
        settings.lens.index = self.named.then_some(self.ours);
        settings
    }

    /// When the shutter opened.
    fn times(&self, chance: &mut Chance) -> Vec<f64> {
        Rhythm { interval: self.interval, regular: self.regular, line: self.line }.times(
            chance,
            BEGIN_S,
            self.exposures,
        )
    }

    fn late(&self, chance: &mut Chance, share: f64) -> f64 {
        if chance.yes(share) { chance.between(0.0, 1.5 * self.interval) } else { 0.0 }
    }

    /// One exposure's announcement, `number` by its camera's count.
    fn announce(
        &self,
        chance: &mut Chance,
        to: &mut Sortie,
        system: u8,
        (camera, number): (u8, usize),
        at: f64,
    ) -> bool {
        if chance.yes(self.lost) {
            return false;
        }
        let said = at + chance.between(-0.005, 0.005);
        let ([lat, lon], alt_m) = on_earth(place(system, at));
        let bytes = match self.by {
            By::Feedback => to.encode(
                (system, 1),
                &CAMERA_FEEDBACK_DATA {
                    time_usec: unix_us(said),
                    cam_idx: camera,
                    img_idx: number as u16,
                    lat,
                    lng: lon,
                    alt_msl: alt_m as f32,
                    ..CAMERA_FEEDBACK_DATA::default()
                },
            ),
            By::Captured(result) => to.encode(
                (system, 1),
                &CAMERA_IMAGE_CAPTURED_DATA {
                    time_boot_ms: boot_ms(said),
                    time_utc: unix_us(said),
                    camera_id: camera,
                    image_index: number as i32,
                    lat,
                    lon,
                    alt: (alt_m * 1e3) as i32,
                    capture_result: MavBool::from_bits_retain(result),
                    ..CAMERA_IMAGE_CAPTURED_DATA::default()
                },
            ),
        };
        let heard = at + self.announced_after + chance.between(0.0, 0.05) + self.late(chance, self.reordered);
        if chance.yes(self.doubled) {
            to.arrives(heard + chance.between(0.0, 1.5), bytes.clone());
        }
        to.arrives(heard, bytes);
        true
    }

    /// All that reaches the aircraft, and of which exposures it is told and gets the picture: their times.
    pub fn sortie(&self, chance: &mut Chance) -> (Sortie, Vec<f64>, Vec<f64>) {
        let mut sortie = Sortie::default();
        let times = self.times(chance);
        let end = times.last().copied().unwrap_or(BEGIN_S) + self.interval;
        for system in 1..=self.vehicles {
            let hz = if system == self.system { 5.0 } else { 1.0 };
            sortie.telemetry(system, [2.0, end + 8.0], hz, |at| place(system, at));
            if system != self.system {
                let others = self.times(chance);
                (1..).zip(others).for_each(|(number, at)| {
                    self.announce(chance, &mut sortie, system, (0, number), at + 0.37 * self.interval);
                });
            }
        }
        let mut index = 0;
        for other in &self.others {
            index += u8::from(index == self.ours);
            let (first, own) = (chance.count(1, 400), self.times(chance));
            for k in 0..self.exposures {
                let at = match other {
                    Other::Together => times[k] + chance.between(0.0, 0.02),
                    Other::Alone => BEGIN_S + (own[k] - BEGIN_S) * 1.37 - 0.6,
                    Other::Shifted(s) => times[k] + s,
                };
                self.announce(chance, &mut sortie, self.system, (index, first + k), at);
            }
            index += 1;
        }
        let (mut told, mut taken, mut number) = (Vec::new(), Vec::new(), 100);
        for (k, at) in times.iter().copied().enumerate() {
            let (is_first, is_last) = (k == 0, k + 1 == times.len());
            let unheard = self.cut.is_some_and(|cut| cut.is_unheard(is_first, is_last));
            let untaken = self.cut.is_some_and(|cut| cut.is_untaken(is_first, is_last));
            if !unheard && self.announce(chance, &mut sortie, self.system, (self.ours, k + 1), at) {
                told.push(at);
            }
            if untaken || chance.yes(self.not_taken) {
                continue;
            }
            number += 1;
            if chance.yes(self.lost_pictures) {
                continue;
            }
            let whole =
                at + self.latency + 2.0 * chance.between(0.0, self.jitter) + self.late(chance, 0.3 * self.reordered);
            let clues = PictureClues {
                arrived_ns: (whole * SECOND) as u64,
                number: self.numbered.then_some(number),
                camera_ns: self.camera_clock.then_some(((at + CAMERA_AHEAD_S).floor() * SECOND) as u64),
                camera_resolution_ns: 1_000_000_000,
                ..Default::default()
            };
            sortie.takes(clues, format!("{}", taken.len()));
            taken.push(at);
        }
        (sortie, told, taken)
    }
}

/// Where an aircraft is: straight on to the east, the fleet's abreast.
fn place(system: u8, at_s: f64) -> DVec3 {
    DVec3::new(SPEED_M_S * at_s, 300.0 * f64::from(system), 40.0)
}
