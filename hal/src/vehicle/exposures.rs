//! Exposures on their way to frames: their poses are looked up as soon as the track reaches past them, their pictures when
//! they come.

use heapless::Deque;

use super::{CameraPose, Event, Frame, Unmatched, UnmatchedReason, Vehicle};
use crate::camera::{Picture, exif_pose};
use crate::error::Error;
use crate::error::{ErrorKind, HalError};
use crate::matcher::{Outcome, Reason};
use crate::pose::{BodyPose, PoseError};
use crate::traits::{Camera, Clock, Link, PictureClues, PoseSource};
use crate::trigger::{Trigger, TriggerKind};

/// Exposures whose pose is kept: more than the matcher keeps waiting.
const EXPOSURES: usize = 96;
/// A pose that is still in the future of the track after this is taken from what there is, ns.
const POSE_PATIENCE_NS: u64 = 1_000_000_000;
/// Uncertainty of a free-running picture's time, s.
const FREE_RUNNING_SIGMA_NS: u64 = 50_000_000;

#[derive(Clone, Copy)]
struct Exposure {
    trigger: Trigger,
    /// Middle of the exposure, boot clock.
    mid_boot_ns: u64,
    heard_ns: u64,
    pose: Option<Result<BodyPose, PoseError>>,
}

/// The exposures whose pose is sought or known.
#[derive(Default)]
pub(super) struct Exposures {
    ring: Deque<Exposure, EXPOSURES>,
}

impl Exposures {
    pub(super) fn push(&mut self, trigger: Trigger, mid_boot_ns: u64, heard_ns: u64) {
        if self.ring.is_full() {
            self.ring.pop_front();
        }
        let _ = self.ring.push_back(Exposure { trigger, mid_boot_ns, heard_ns, pose: None });
    }

    fn find(&self, trigger: &Trigger) -> Option<&Exposure> {
        let same = |e: &&Exposure| e.trigger.sequence == trigger.sequence && e.trigger.boot_ns == trigger.boot_ns;
        self.ring.iter().rev().find(same)
    }
}

/// A picture whose exposure is known and whose pose may not be yet.
pub(super) struct PendingFrame {
    trigger: Trigger,
    picture: Picture,
}

fn path_of(picture: &Picture) -> Option<std::path::PathBuf> {
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
                    self.counters.pictures += 1;
                    if self.is_free_running() {
                        self.take_free_running(&clues, picture, now_ns);
                    } else if let Some(outcome) = self.matcher.push_picture(clues, picture) {
                        self.take_outcome(outcome, now_ns);
                    }
                }
                Ok(None) => break,
                Err(e) => {
                    self.service.complain(&e, now_ns);
                    if e.kind() != ErrorKind::Device {
                        break; // the camera, not a picture
                    }
                    self.counters.pictures_broken += 1;
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
            self.counters.poseless += 1;
            return;
        };
        let sequence = u32::try_from(self.counters.pictures).unwrap_or(u32::MAX);
        let trigger =
            Trigger { sequence, boot_ns, time_ns, sigma_ns: FREE_RUNNING_SIGMA_NS, kind: TriggerKind::Command };
        self.exposures.push(trigger, boot_ns, now_ns);
        self.wait_for_pose(trigger, picture);
    }

    /// Everything that can be decided now.
    pub(super) fn settle(&mut self, now_ns: u64) {
        self.take_triggers(now_ns);
        for exposure in self.exposures.ring.iter_mut().filter(|e| e.pose.is_none()) {
            exposure.pose = match self.autopilot.pose_at(exposure.mid_boot_ns) {
                Err(PoseError::NotYet | PoseError::Empty) => {
                    let given_up = now_ns.saturating_sub(exposure.heard_ns) > POSE_PATIENCE_NS;
                    given_up.then(|| self.autopilot.pose_near(exposure.mid_boot_ns))
                }
                known => Some(known),
            };
        }
        while let Some(outcome) = self.matcher.poll(now_ns) {
            self.take_outcome(outcome, now_ns);
        }
        self.hand_out(false);
    }

    /// The flight is over: decides everything that waits, so that no picture and no exposure goes unaccounted for.
    pub fn finish(&mut self) {
        if self.finished {
            return;
        }
        let now_ns = self.now_ns();
        self.settle(now_ns);
        for exposure in self.exposures.ring.iter_mut().filter(|e| e.pose.is_none()) {
            exposure.pose = Some(self.autopilot.pose_near(exposure.mid_boot_ns));
        }
        while let Some(outcome) = self.matcher.flush() {
            self.take_outcome(outcome, now_ns);
        }
        self.hand_out(true);
        self.finished = true;
    }

    pub(super) fn take_outcome(&mut self, outcome: Outcome<Picture>, _now_ns: u64) {
        match outcome {
            Outcome::Matched { trigger, picture, late } => {
                self.counters.pictures_late += u64::from(late);
                self.pictureless = 0;
                self.wait_for_pose(trigger, picture);
            }
            Outcome::Picture { picture, reason, .. } => {
                if reason == Reason::Duplicate {
                    self.counters.picture_duplicates += 1;
                } else if self.use_exif(None, &picture) {
                    return;
                } else {
                    self.counters.pictures_unmatched += 1;
                }
                self.unmatched(None, path_of(&picture), UnmatchedReason::Matching(reason));
            }
            Outcome::Trigger { trigger, reason } => {
                self.counters.triggers_unmatched += 1;
                self.pictureless = self.pictureless.saturating_add(1);
                self.unmatched(Some(trigger.sequence), None, UnmatchedReason::Matching(reason));
            }
        }
    }

    fn wait_for_pose(&mut self, trigger: Trigger, picture: Picture) {
        if self.pending.is_full()
            && let Some(oldest) = self.pending.pop_front()
        {
            self.counters.poseless += 1;
            self.unmatched(Some(oldest.trigger.sequence), path_of(&oldest.picture), UnmatchedReason::Overflow);
        }
        let _ = self.pending.push_back(PendingFrame { trigger, picture });
    }

    fn hand_out(&mut self, at_end: bool) {
        for _ in 0..self.pending.len() {
            let Some(waiting) = self.pending.pop_front() else { break };
            let (pose, mid_boot_ns) = match self.exposures.find(&waiting.trigger) {
                Some(exposure) => (exposure.pose, exposure.mid_boot_ns),
                None => (Some(Err(PoseError::TooOld)), waiting.trigger.boot_ns),
            };
            match pose {
                None if !at_end => drop(self.pending.push_back(waiting)),
                None => self.give_up(waiting, UnmatchedReason::Pose(PoseError::NotYet)),
                Some(Err(e)) => self.give_up(waiting, UnmatchedReason::Pose(e)),
                Some(Ok(body)) if self.mount.is_tilted(&body) => {
                    self.counters.exposures_tilted += 1;
                    let (sequence, path) = (waiting.trigger.sequence, path_of(&waiting.picture));
                    self.unmatched(Some(sequence), path, UnmatchedReason::Tilted);
                }
                Some(Ok(body)) => {
                    let sigma_s = waiting.trigger.sigma_ns as f64 * 1e-9;
                    match self.mount.camera_pose(&body, sigma_s) {
                        Some(pose) => {
                            let speed = body.velocity.length() as f32;
                            self.frame(&waiting.trigger, mid_boot_ns, pose, speed, waiting.picture);
                        }
                        None => self.give_up(waiting, UnmatchedReason::NoGimbal),
                    }
                }
            }
        }
    }

    fn frame(&mut self, trigger: &Trigger, mid_boot_ns: u64, pose: CameraPose, speed_m_s: f32, picture: Picture) {
        let time_ns = self.autopilot.clock().to_companion_ns(mid_boot_ns).unwrap_or(trigger.time_ns);
        self.counters.posed_frames += 1;
        self.service.captured(trigger.sequence, mid_boot_ns, &pose, self.settings.origin);
        self.emit(Event::Frame(Frame { sequence: trigger.sequence, time_ns, pose, speed_m_s, picture }));
    }

    fn give_up(&mut self, waiting: PendingFrame, reason: UnmatchedReason) {
        if !self.use_exif(Some(&waiting.trigger), &waiting.picture) {
            self.counters.poseless += 1;
            self.unmatched(Some(waiting.trigger.sequence), path_of(&waiting.picture), reason);
        }
    }

    /// A frame with the picture's own pose, when the mission allows it and the picture has one.
    fn use_exif(&mut self, trigger: Option<&Trigger>, picture: &Picture) -> bool {
        let Picture::Path(path) = picture else { return false };
        if !self.settings.link.exif_pose {
            return false;
        }
        let Some(pose) = exif_pose(path).and_then(|e| self.mount.exif_pose(&e)) else { return false };
        self.counters.exif_poses += 1;
        self.counters.posed_frames += 1;
        let frame = Frame {
            sequence: trigger.map_or(0, |t| t.sequence),
            time_ns: trigger.map_or(self.now_ns(), |t| t.time_ns),
            pose,
            speed_m_s: 0.0,
            picture: picture.clone(),
        };
        self.emit(Event::Frame(frame));
        true
    }

    fn unmatched(&mut self, sequence: Option<u32>, picture: Option<std::path::PathBuf>, reason: UnmatchedReason) {
        self.emit(Event::Unmatched(Unmatched { sequence, picture, reason }));
    }
}
