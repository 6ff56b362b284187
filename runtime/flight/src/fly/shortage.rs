//! Why a flight brought too few key frames, by what was counted on the way: from the link over the poses and the exposures to
//! the pictures, the first that explains it is the cause.

use super::intake::FlightCounters;

/// One line with the count that gives it away and the remedy.
pub(super) fn likely_cause(flight: &FlightCounters) -> String {
    let (h, k) = (&flight.hal, &flight.keyframes);
    let refused = h.wrong_key + h.unsigned + h.replayed;
    if refused > 0 && 2 * refused >= h.frames {
        return format!(
            "signing refused {refused} of {} messages ({} of another key, {} unsigned, {} with an old time stamp); \
             check [link] signing_key against the autopilot's",
            h.frames, h.wrong_key, h.unsigned, h.replayed
        );
    }
    if h.frames == 0 {
        let damaged = h.damaged;
        return format!(
            "no MAVLink message was heard ({damaged} damaged stretches); check the link, its baud rate and port"
        );
    }
    if h.positions == 0 {
        let unfixed = h.unfixed;
        return format!("no position was heard ({unfixed} before the first fix); check the GPS and the stream rates");
    }
    if h.pictures == 0 {
        let (triggers, broken) = (h.triggers, h.pictures_broken);
        return format!("no picture came for {triggers} exposures ({broken} broken); check the camera and its folder");
    }
    if h.triggers == 0 && h.posed_frames == 0 {
        let pictures = h.pictures;
        return format!(
            "no exposure was announced for {pictures} pictures; check the autopilot's camera trigger, or set [link] free_running"
        );
    }
    let useless = h.pictures_black + h.pictures_overexposed + h.pictures_constant + h.pictures_broken;
    let near = u64::from(k.too_close + k.covered);
    // From here on several may have happened: the one that cost most is named.
    let losses = [
        (h.exposures_tilted, "were taken tilted; check [mount] rotation_deg and max_tilt_deg"),
        (
            useless + u64::from(flight.undecodable),
            "show nothing or cannot be decoded; check the lens cap and the exposure",
        ),
        (h.poseless, "have no pose; check the rates of position, attitude and gimbal"),
        (h.pictures_unmatched, "found no exposure; check [link] picture_latency_ms and patience_s"),
        (near, "are too near to others; check [keyframes] t_min_m"),
    ];
    match losses.into_iter().max_by_key(|loss| loss.0) {
        Some((count @ 1.., why)) => format!("{count} of {} pictures {why}", h.pictures),
        _ => format!("the flight had {} pictures and {} exposures; fly longer", h.pictures, h.triggers),
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
        HalCounters {
            frames: 900,
            positions: 300,
            triggers: 10,
            pictures: 10,
            posed_frames: 10,
            ..HalCounters::default()
        }
    }

    #[test]
    fn a_wrong_key_is_blamed_before_the_pictures_that_found_no_exposure() {
        let hal = HalCounters {
            frames: 700,
            wrong_key: 690,
            pictures: 10,
            pictures_unmatched: 10,
            positions: 0,
            ..HalCounters::default()
        };
        let text = cause(hal);
        assert!(text.starts_with("signing refused 690 of 700 messages (690 of another key"), "{text}");
        assert!(
            cause(HalCounters { wrong_key: 3, pictures: 0, ..whole() }).starts_with("no picture"),
            "a few are none"
        );
    }

    #[test]
    fn silence_missing_positions_triggers_and_pictures_are_told_apart() {
        let told = [
            (HalCounters { damaged: 12, ..HalCounters::default() }, "no MAVLink message was heard (12 damaged"),
            (HalCounters { positions: 0, unfixed: 80, ..whole() }, "no position was heard (80 before"),
            (HalCounters { pictures: 0, ..whole() }, "no picture came for 10 exposures"),
            (
                HalCounters { triggers: 0, posed_frames: 0, pictures_unmatched: 10, ..whole() },
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
        let text = cause(HalCounters { pictures_black: 2, exposures_tilted: 7, poseless: 1, ..whole() });
        assert!(text.starts_with("7 of 10 pictures were taken tilted"), "{text}");
        let keyframes = KeyframeCounters { key: 1, too_close: 9, ..KeyframeCounters::default() };
        let text = likely_cause(&FlightCounters { keyframes, hal: whole(), ..FlightCounters::default() });
        assert!(text.starts_with("9 of 10 pictures are too near"), "{text}");
        assert!(cause(whole()).contains("fly longer"));
    }
}
