//! Why a flight brought too few key frames, by what was counted on the way: from the link over the poses and the exposures to
//! the pictures, the first that explains it is the cause.

use super::intake::FlightCounters;

/// One line with the count that gives it away and the remedy.
pub(super) fn likely_cause(flight: &FlightCounters) -> String {
    let (h, k) = (&flight.hal, &flight.keyframes);
    let refused = h.link.wrong_key + h.link.unsigned + h.link.replayed;
    if refused > 0 && 2 * refused >= h.link.frames {
        return format!(
            "signing refused {refused} of {} messages ({} of another key, {} unsigned, {} with an old time stamp); \
             check [link] signing_key against the autopilot's",
            h.link.frames, h.link.wrong_key, h.link.unsigned, h.link.replayed
        );
    }
    if h.link.frames == 0 {
        let damaged = h.link.damaged;
        return format!(
            "no MAVLink message was heard ({damaged} damaged stretches); check the link, its baud rate and port"
        );
    }
    if h.telemetry.positions == 0 {
        let unfixed = h.telemetry.unfixed;
        return format!("no position was heard ({unfixed} before the first fix); check the GPS and the stream rates");
    }
    if h.pictures.pictures == 0 {
        let (triggers, broken) = (h.exposures.triggers, h.pictures.pictures_broken);
        return format!("no picture came for {triggers} exposures ({broken} broken); check the camera and its folder");
    }
    if h.exposures.triggers == 0 && h.posed_frames == 0 {
        let pictures = h.pictures.pictures;
        return format!(
            "no exposure was announced for {pictures} pictures; check the autopilot's camera trigger, or set [link] free_running"
        );
    }
    let useless = h.pictures.pictures_black
        + h.pictures.pictures_overexposed
        + h.pictures.pictures_constant
        + h.pictures.pictures_broken;
    let near = u64::from(k.too_close + k.covered);
    // From here on several may have happened: the one that cost most is named.
    let losses = [
        (h.exposures.exposures_tilted, "were taken tilted; check [mount] rotation_deg and max_tilt_deg"),
        (
            useless + u64::from(flight.undecodable),
            "show nothing or cannot be decoded; check the lens cap and the exposure",
        ),
        (h.exposures.poseless, "have no pose; check the rates of position, attitude and gimbal"),
        (h.pictures.pictures_unmatched, "found no exposure; check [link] picture_latency_ms and patience_s"),
        (near, "are too near to others; check [keyframes] t_min_m"),
    ];
    match losses.into_iter().max_by_key(|loss| loss.0) {
        Some((count @ 1.., why)) => format!("{count} of {} pictures {why}", h.pictures.pictures),
        _ => format!(
            "the flight had {} pictures and {} exposures; fly longer",
            h.pictures.pictures, h.exposures.triggers
        ),
    }
}

#[cfg(test)]
mod tests {
    use hal::counters::HalCounters;

    use super::*;
    use crate::capture::KeyframeCounters;

    fn cause(hal: HalCounters) -> String {
        likely_cause(&FlightCounters { hal, ..FlightCounters::default() })
    }

    /// A flight in which everything came.
    fn whole() -> HalCounters {
        let mut hal = HalCounters { posed_frames: 10, ..HalCounters::default() };
        (hal.link.frames, hal.telemetry.positions) = (900, 300);
        (hal.exposures.triggers, hal.pictures.pictures) = (10, 10);
        hal
    }

    /// `hal` with one thing otherwise.
    fn but(mut hal: HalCounters, change: fn(&mut HalCounters)) -> HalCounters {
        change(&mut hal);
        hal
    }

    #[test]
    fn a_wrong_key_is_blamed_before_the_pictures_that_found_no_exposure() {
        let text = cause(but(HalCounters::default(), |h| {
            (h.link.frames, h.link.wrong_key) = (700, 690);
            (h.pictures.pictures, h.pictures.pictures_unmatched) = (10, 10);
        }));
        assert!(text.starts_with("signing refused 690 of 700 messages (690 of another key"), "{text}");
        let few = but(whole(), |h| (h.link.wrong_key, h.pictures.pictures) = (3, 0));
        assert!(cause(few).starts_with("no picture"), "a few are none");
    }

    #[test]
    fn silence_missing_positions_triggers_and_pictures_are_told_apart() {
        let told = [
            (but(HalCounters::default(), |h| h.link.damaged = 12), "no MAVLink message was heard (12 damaged"),
            (
                but(whole(), |h| (h.telemetry.positions, h.telemetry.unfixed) = (0, 80)),
                "no position was heard (80 before",
            ),
            (but(whole(), |h| h.pictures.pictures = 0), "no picture came for 10 exposures"),
            (
                but(whole(), |h| {
                    (h.exposures.triggers, h.posed_frames, h.pictures.pictures_unmatched) = (0, 0, 10);
                }),
                "no exposure was announced",
            ),
        ];
        for (hal, part) in told {
            let text = cause(hal);
            assert!(text.starts_with(part), "{text}");
        }
    }

    #[test]
    fn of_several_losses_the_largest_is_named() {
        let text = cause(but(whole(), |h| {
            (h.pictures.pictures_black, h.exposures.exposures_tilted, h.exposures.poseless) = (2, 7, 1);
        }));
        assert!(text.starts_with("7 of 10 pictures were taken tilted"), "{text}");
        let keyframes = KeyframeCounters { key: 1, too_close: 9, ..KeyframeCounters::default() };
        let text = likely_cause(&FlightCounters { keyframes, hal: whole(), ..FlightCounters::default() });
        assert!(text.starts_with("9 of 10 pictures are too near"), "{text}");
        assert!(cause(whole()).contains("fly longer"));
    }
}
