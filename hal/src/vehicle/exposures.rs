//! Exposures on their way to posed pictures: their poses are looked up as soon as the track reaches past them and kept for the
//! whole flight, their pictures when they come. What found no partner in flight is compared once more at its end.

use std::path::PathBuf;

use super::cameras::Passage;
use super::{CameraPose, Event, PosedPicture, Unmatched, UnmatchedReason, Vehicle};
use crate::camera::{Picture, exif_pose};
use crate::error::{Error, ErrorKind, HalError};
use crate::matcher::{Outcome, Reason};
use crate::pose::PoseError;
use crate::traits::{Camera, Clock, Link, PictureClues, PoseSource};
use crate::trigger::{Source, Trigger, TriggerKind};

mod ledger;

pub(super) use ledger::Exposures;
use ledger::{EXPOSURES, Exposure, PUT_ASIDE, Partner, PutAside};

/// Matched pictures that wait for their pose at the same time, as a rule.
const PENDING: usize = 32;
/// Poses are found within seconds: only so many of the newest exposures can still be without.
const UNPOSED: usize = 128;
/// A pose that is still in the future of the track after this is taken from what there is, ns.
const POSE_PATIENCE_NS: u64 = 1_000_000_000;
/// Uncertainty of a free-running picture's time, ns.
const FREE_RUNNING_SIGMA_NS: u64 = 50_000_000;
/// In flight what was put aside is compared this often, and believed only when it is all but certain.
const RECONCILE_EVERY_NS: u64 = 10_000_000_000;
const CERTAIN: f32 = 0.999;
/// Late pictures and their like are handed out while at most so many events wait.
const EVENTS_WAITING: usize = 64;

/// A picture whose exposure is known and whose pose may not be yet.
pub(super) struct PendingPicture {
    trigger: Trigger,
    picture: Picture,
    confidence: f32,
}

fn path_of(picture: &Picture) -> Option<PathBuf> {
    match picture {
        Picture::Path(path) => Some(path.clone()),
        Picture::Jpeg(_) | Picture::Rgb(_) => None,
    }
}

impl<L, C, K> Vehicle<L, C, K>
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    pub(super) fn take_pictures(&mut self, now_ns: u64) {
        // Bounded: a folder full of pictures must not keep the link waiting.
        for _ in 0..8 {
            match self.camera.next_picture(now_ns) {
                Ok(Some((clues, picture))) => {
                    self.counters.pictures.pictures += 1;
                    self.trouble.pictureless = 0;
                    if self.is_free_running() {
                        self.take_free_running(&clues, picture, now_ns);
                    } else if let Passage::Through((clues, picture)) =
                        self.exposures.cameras.take_picture(clues, picture)
                        && let Some(outcome) = self.matcher.push_picture(clues, picture)
                    {
                        self.take_outcome(outcome);
                    }
                }
                Ok(None) => break,
                Err(e) => {
                    self.service.warn_seldom(&e, now_ns);
                    if e.kind() != ErrorKind::Device {
                        break; // the camera, not a picture
                    }
                    self.counters.pictures.pictures_broken += 1;
                }
            }
        }
    }

    /// Pictures nobody announced are their own exposures.
    fn take_free_running(&mut self, clues: &PictureClues, picture: Picture, now_ns: u64) {
        let ns = |ms: f32| (f64::from(ms.max(0.0)) * 1e6) as u64;
        let delay_ns = (f64::from(self.settings.lens.exposure_delay_ms) * 1e6) as i64;
        let time_ns = match clues.stamped_ns {
            Some(stamped_ns) => stamped_ns.saturating_add_signed(delay_ns),
            None => clues.arrived_ns.saturating_sub(ns(self.settings.link.picture_latency_ms)),
        };
        if !self.service.is_due(time_ns, ns(self.settings.link.picture_interval_ms)) {
            return;
        }
        let Some(boot_ns) = self.autopilot.clock().to_boot_ns(time_ns) else {
            self.counters.exposures.poseless += 1;
            return;
        };
        let sequence = u32::try_from(self.counters.pictures.pictures).unwrap_or(u32::MAX);
        let (source, kind) = (Source::default(), TriggerKind::Command);
        let trigger = Trigger { source, sequence, boot_ns, time_ns, sigma_ns: FREE_RUNNING_SIGMA_NS, kind };
        self.exposures.push(trigger, boot_ns, now_ns, false);
        self.wait_for_pose(PendingPicture { trigger, picture, confidence: 1.0 });
    }

    /// Everything that can be decided now.
    pub(super) fn settle(&mut self, now_ns: u64) {
        self.take_triggers(now_ns);
        for exposure in self.exposures.all.iter_mut().rev().take(UNPOSED).filter(|e| e.pose.is_none()) {
            exposure.pose = match self.autopilot.pose_at(exposure.mid_boot_ns) {
                Err(PoseError::NotYet | PoseError::Empty) => {
                    let given_up = now_ns.saturating_sub(exposure.heard_ns) > POSE_PATIENCE_NS;
                    given_up.then(|| self.autopilot.pose_near(exposure.mid_boot_ns))
                }
                known => Some(known),
            };
        }
        for outcome in self.exposures.choose_camera(&mut self.matcher, false) {
            self.take_outcome(outcome);
        }
        while let Some(outcome) = self.matcher.poll(now_ns) {
            self.take_outcome(outcome);
        }
        if now_ns >= self.exposures.next_reconcile_ns {
            self.exposures.next_reconcile_ns = now_ns.saturating_add(RECONCILE_EVERY_NS);
            if !self.exposures.aside.is_empty() && self.exposures.await_pictures() {
                let pairs = self.exposures.reconcile(CERTAIN);
                self.take_pairs(pairs);
            }
        }
        self.hand_out(false);
    }

    /// Takes pictures that were put aside and found their exposure later.
    fn take_pairs(&mut self, pairs: Vec<(Trigger, PutAside, f32)>) {
        for (trigger, aside, confidence) in pairs {
            tracing::debug!(
                "exposure {} and {} paired late, {confidence:.2}",
                trigger.sequence,
                aside.picture.name().display()
            );
            self.counters.pictures.pictures_reconciled += 1;
            self.found(trigger, aside.picture, aside.clues, confidence.min(self.exposures.cameras.confidence()));
        }
    }

    /// The flight is over: decides everything that waits, so that no picture and no exposure goes unaccounted for.
    pub fn finish(&mut self) {
        if self.finished {
            return;
        }
        let now_ns = self.now_ns();
        // Whatever the camera has by now.
        for _ in 0..PUT_ASIDE {
            let before = self.counters.pictures.pictures;
            self.take_pictures(now_ns);
            if self.counters.pictures.pictures == before {
                break;
            }
        }
        self.settle(now_ns);
        for exposure in self.exposures.all.iter_mut().filter(|e| e.pose.is_none()) {
            exposure.pose = Some(self.autopilot.pose_near(exposure.mid_boot_ns));
        }
        for outcome in self.exposures.choose_camera(&mut self.matcher, true) {
            self.take_outcome(outcome);
        }
        while let Some(outcome) = self.matcher.flush() {
            self.take_outcome(outcome);
        }
        // The whole flight once more, with both ends; then by votes what is still alone.
        let landing = self.exposures.align(self.matcher.settings());
        for (severity, doubt) in landing.doubts() {
            self.status_text(severity, &doubt);
        }
        self.take_pairs(landing.pairs);
        let pairs = self.exposures.reconcile(0.0);
        self.take_pairs(pairs);
        for PutAside { clues, picture, reason } in std::mem::take(&mut self.exposures.aside) {
            let taken =
                |e: &Exposure| matches!(e.partner, Partner::Found(c) if c.number.is_some() && c.number == clues.number);
            if self.exposures.all.iter().any(taken) {
                self.counters.pictures.picture_duplicates += 1;
                self.unmatched(None, path_of(&picture), UnmatchedReason::Matching(Reason::Duplicate));
            } else {
                self.picture_alone(&picture, reason);
            }
        }
        let missing: Vec<u32> = self.exposures.awaited().map(|e| e.trigger.sequence).collect();
        for sequence in missing {
            self.counters.exposures.triggers_unmatched += 1;
            self.unmatched(Some(sequence), None, UnmatchedReason::Matching(Reason::NoPicture));
        }
        self.finished = true;
    }

    pub(super) fn take_outcome(&mut self, outcome: Outcome<Picture>) {
        match outcome {
            Outcome::Matched { trigger, picture, clues, late, confidence } => {
                self.counters.pictures.pictures_late += u64::from(late);
                self.found(trigger, picture, clues, confidence.min(self.exposures.cameras.confidence()));
            }
            Outcome::Picture { picture, reason: Reason::Duplicate, .. } => {
                self.counters.pictures.picture_duplicates += 1;
                self.unmatched(None, path_of(&picture), UnmatchedReason::Matching(Reason::Duplicate));
            }
            // Its exposure may be among those whose picture has not come; pixels in memory cannot wait for that.
            Outcome::Picture { picture: picture @ Picture::Path(_), clues, reason }
                if self.exposures.await_pictures() && self.exposures.aside.len() < PUT_ASIDE =>
            {
                self.exposures.aside.push(PutAside { clues, picture, reason });
            }
            Outcome::Picture { picture, clues, reason } => {
                self.exposures.stays_alone(clues);
                self.picture_alone(&picture, reason);
            }
            // Its picture may still come: it counts as missing at the end of the flight.
            Outcome::Trigger { .. } => self.trouble.pictureless = self.trouble.pictureless.saturating_add(1),
        }
    }

    /// A picture and its exposure have found each other.
    fn found(&mut self, trigger: Trigger, picture: Picture, clues: PictureClues, confidence: f32) {
        if let Some(exposure) = self.exposures.find(&trigger) {
            exposure.partner = Partner::Found(clues);
        }
        self.wait_for_pose(PendingPicture { trigger, picture, confidence });
    }

    fn picture_alone(&mut self, picture: &Picture, reason: Reason) {
        if !self.use_exif(None, picture) {
            self.counters.pictures.pictures_unmatched += 1;
            self.unmatched(None, path_of(picture), UnmatchedReason::Matching(reason));
        }
    }

    fn wait_for_pose(&mut self, waiting: PendingPicture) {
        if self.exposures.pending.len() >= EXPOSURES
            && let Some(oldest) = self.exposures.pending.pop_front()
        {
            self.counters.exposures.poseless += 1;
            self.unmatched(Some(oldest.trigger.sequence), path_of(&oldest.picture), UnmatchedReason::Overflow);
        }
        self.exposures.pending.push_back(waiting);
    }

    /// Pictures whose pose is known become events, while somebody fetches them.
    pub(super) fn hand_out(&mut self, at_end: bool) {
        for _ in 0..self.exposures.pending.len() {
            if self.events.len() >= EVENTS_WAITING {
                return;
            }
            let Some(waiting) = self.exposures.pending.pop_front() else { break };
            let (pose, mid_boot_ns) = match self.exposures.find(&waiting.trigger) {
                Some(exposure) => (exposure.pose, exposure.mid_boot_ns),
                None => (Some(Err(PoseError::TooOld)), waiting.trigger.boot_ns),
            };
            match pose {
                None if !at_end => self.exposures.pending.push_back(waiting),
                None => self.give_up(waiting, UnmatchedReason::Pose(PoseError::NotYet)),
                Some(Err(e)) => self.give_up(waiting, UnmatchedReason::Pose(e)),
                Some(Ok(body)) if self.mount.is_tilted(&body) => {
                    self.counters.exposures.exposures_tilted += 1;
                    let (sequence, path) = (waiting.trigger.sequence, path_of(&waiting.picture));
                    self.unmatched(Some(sequence), path, UnmatchedReason::Tilted);
                }
                Some(Ok(body)) => {
                    let sigma_s = waiting.trigger.sigma_ns as f64 * 1e-9;
                    match self.mount.camera_pose(&body, sigma_s) {
                        Some(pose) => self.posed(waiting, mid_boot_ns, pose, body.velocity.length() as f32),
                        None => self.give_up(waiting, UnmatchedReason::NoGimbal),
                    }
                }
            }
        }
        while self.events.len() < EVENTS_WAITING {
            let Some(event) = self.exposures.closing.pop_front() else { break };
            self.events.push(event);
        }
    }

    fn posed(&mut self, waiting: PendingPicture, mid_boot_ns: u64, pose: CameraPose, speed_m_s: f32) {
        let PendingPicture { trigger, picture, confidence } = waiting;
        let time_ns = self.autopilot.clock().to_companion_ns(mid_boot_ns).unwrap_or(trigger.time_ns);
        self.counters.posed_frames += 1;
        let unix_us = self.autopilot.unix_us(mid_boot_ns);
        self.service.captured(mid_boot_ns, unix_us, &pose, self.settings.origin);
        let sequence = trigger.sequence;
        self.events.push(Event::Posed(PosedPicture { sequence, time_ns, pose, speed_m_s, confidence, picture }));
    }

    fn give_up(&mut self, waiting: PendingPicture, reason: UnmatchedReason) {
        if !self.use_exif(Some(&waiting.trigger), &waiting.picture) {
            self.counters.exposures.poseless += 1;
            self.unmatched(Some(waiting.trigger.sequence), path_of(&waiting.picture), reason);
        }
    }

    /// A picture with its own pose, when the mission allows it and it has one.
    fn use_exif(&mut self, trigger: Option<&Trigger>, picture: &Picture) -> bool {
        let Picture::Path(path) = picture else { return false };
        if !self.settings.link.exif_pose {
            return false;
        }
        let Some(pose) = exif_pose(path).and_then(|e| self.mount.exif_pose(&e)) else { return false };
        self.counters.exif_poses += 1;
        self.counters.posed_frames += 1;
        self.report(Event::Posed(PosedPicture {
            sequence: trigger.map_or(0, |t| t.sequence),
            time_ns: trigger.map_or(self.now_ns(), |t| t.time_ns),
            pose,
            speed_m_s: 0.0,
            confidence: 1.0,
            picture: picture.clone(),
        }));
        true
    }

    fn unmatched(&mut self, sequence: Option<u32>, picture: Option<PathBuf>, reason: UnmatchedReason) {
        self.report(Event::Unmatched(Unmatched { sequence, picture, reason }));
    }

    /// At once, or, when the end of the flight decides many things at the same time, as there is room.
    fn report(&mut self, event: Event) {
        if self.events.len() < EVENTS_WAITING {
            self.events.push(event);
        } else {
            self.exposures.closing.push_back(event);
        }
    }
}
