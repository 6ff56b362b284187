//! Means over seeds, the Pareto front, and the time one way of starting saves over another at equal quality.

use serde::Serialize;

/// Several runs that differ only in their seed.
#[derive(Clone, Debug, Serialize)]
pub struct Group {
    /// Name of the data set.
    pub dataset: String,
    /// Where the first Gaussians came from.
    pub init: String,
    /// Device memory, MiB.
    pub budget_mib: u32,
    /// Seconds of training asked for.
    pub asked_s: f64,
    /// Runs.
    pub runs: usize,
    /// Mean seconds from the first picture to the model, initialisation included.
    pub total_s: f64,
    /// Mean held-out PSNR, dB.
    pub psnr: f64,
    /// Least and greatest PSNR over the seeds.
    pub psnr_range: [f64; 2],
    /// Mean held-out SSIM.
    pub ssim: f64,
    /// Mean perceptual distance, when a network was configured.
    pub perceptual: Option<f64>,
    /// Mean number of Gaussians.
    pub gaussians: f64,
    /// Whether no other group of the data set is both faster and better.
    pub on_front: bool,
}

/// Marks the groups that no other group of the same data set beats in both time and PSNR.
pub fn mark_front(groups: &mut [Group]) {
    for i in 0..groups.len() {
        let g = &groups[i];
        let beaten = groups.iter().enumerate().any(|(j, o)| {
            let no_worse = o.total_s <= g.total_s && o.psnr >= g.psnr;
            let better = o.total_s < g.total_s || o.psnr > g.psnr || j < i;
            j != i && o.dataset == g.dataset && no_worse && better
        });
        groups[i].on_front = !beaten;
    }
}

/// Seconds until a curve of (seconds, PSNR) first reaches `psnr`, straight lines between its points; `None` when it never
/// does. A curve that starts above it gives its first point's seconds.
pub fn seconds_to(curve: &[(f64, f64)], psnr: f64) -> Option<f64> {
    let mut sorted = curve.to_vec();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut before: Option<(f64, f64)> = None;
    for (s, q) in sorted {
        if q >= psnr {
            return Some(match before {
                Some((s0, q0)) if q > q0 => s0 + (s - s0) * (psnr - q0) / (q - q0),
                _ => s,
            });
        }
        before = Some((s, q));
    }
    None
}

/// One way of starting against another at equal held-out PSNR.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Speedup {
    /// The PSNR both reach, dB.
    pub psnr: f64,
    /// Seconds of the first.
    pub seconds: f64,
    /// Seconds of the second.
    pub other_seconds: f64,
}

impl Speedup {
    /// How many times faster the first is.
    pub fn ratio(&self) -> f64 {
        self.other_seconds / self.seconds
    }
}

/// The comparison at the highest PSNR that both curves reach.
pub fn speedup(curve: &[(f64, f64)], other: &[(f64, f64)]) -> Option<Speedup> {
    let best = |c: &[(f64, f64)]| c.iter().map(|p| p.1).reduce(f64::max);
    let psnr = best(curve)?.min(best(other)?);
    Some(Speedup { psnr, seconds: seconds_to(curve, psnr)?, other_seconds: seconds_to(other, psnr)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(total_s: f64, psnr: f64) -> Group {
        Group {
            dataset: "d".into(),
            init: "sfm".into(),
            budget_mib: 1,
            asked_s: total_s,
            runs: 1,
            total_s,
            psnr,
            psnr_range: [psnr; 2],
            ssim: 0.5,
            perceptual: None,
            gaussians: 1.0,
            on_front: false,
        }
    }

    #[test]
    fn only_what_nothing_beats_in_both_is_on_the_front() {
        let mut groups =
            [group(10.0, 20.0), group(20.0, 19.0), group(30.0, 25.0), group(30.0, 24.0), group(10.0, 20.0)];
        mark_front(&mut groups);
        assert_eq!(groups.map(|g| g.on_front), [true, false, true, false, false]);
    }

    #[test]
    fn equal_quality_is_read_off_the_straight_line_between_points() {
        let slow = [(10.0, 20.0), (30.0, 24.0)];
        assert_eq!(seconds_to(&slow, 22.0), Some(20.0));
        assert_eq!(seconds_to(&slow, 19.0), Some(10.0));
        assert_eq!(seconds_to(&slow, 25.0), None);
        let faster = speedup(&[(5.0, 22.0)], &slow).unwrap();
        assert_eq!((faster.psnr, faster.ratio()), (22.0, 4.0));
        assert_eq!(speedup(&[], &slow), None);
    }
}
