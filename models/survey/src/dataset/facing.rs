//! Whether cameras look at what they share: poses whose axes mean something else than their file's form says look away from it.

use glam::{DMat3, DVec3};

use super::{Dataset, DatasetError};
use models::formats::FormatError;

/// Fewer cameras share nothing for certain.
const LEAST: usize = 3;
/// Share of the cameras that look away, where their axes mean something else.
const MOST: f64 = 0.9;
/// Axes meet where their distances from one place are below this share of the way to it.
const MEET: f64 = 0.5;
/// Axes that are nearly parallel meet nowhere.
const SPREAD: f64 = 0.02;
/// Points that fewer than this share of the cameras have before them are behind all.
const BEFORE: f64 = 0.05;
/// Most points and cameras sampled.
const SAMPLED: usize = 1000;

/// Says so where all cameras look away from the place where their axes meet.
///
/// # Errors
/// The data set's own points lie behind them, too.
pub(super) fn check(set: &Dataset) -> Result<(), DatasetError> {
    let axes: Vec<(DVec3, DVec3)> = set.frames.iter().map(|f| (f.view.pose.center, f.view.pose.forward())).collect();
    if !look_away(&axes) {
        return Ok(());
    }
    let what = "all cameras look away from what they share; is it in OpenCV's axes (y down, z ahead)? transform_matrix is in OpenGL's (y up, z back): change the signs of its second and third column";
    let points = set.sparse_points()?;
    let every = |n: usize| n.div_ceil(SAMPLED).max(1);
    let (mut before, mut all) = (0usize, 0usize);
    for point in points.iter().step_by(every(points.len())) {
        let at = DVec3::from_array(point.position);
        before += axes.iter().step_by(every(axes.len())).filter(|(c, ahead)| (at - *c).dot(*ahead) > 0.0).count();
        all += axes.len().div_ceil(every(axes.len()));
    }
    if all > 0 && (before as f64) < BEFORE * all as f64 {
        return Err(FormatError::invalid(&set.root, format!("{what} (its points lie behind them)")).into());
    }
    tracing::warn!("{}: {what}", set.root.display());
    Ok(())
}

/// Whether the axes (places and directions) meet in one place, behind nearly all of the cameras.
fn look_away(axes: &[(DVec3, DVec3)]) -> bool {
    if axes.len() < LEAST {
        return false;
    }
    // The place nearest to all lines.
    let across = |d: DVec3| DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    let n = axes.len() as f64;
    let sum = axes.iter().fold(DMat3::ZERO, |sum, (_, d)| sum + across(*d)) * (1.0 / n);
    if sum.determinant() < SPREAD {
        return false;
    }
    let place = sum.inverse() * (axes.iter().map(|(c, d)| across(*d) * *c).sum::<DVec3>() / n);
    let behind = axes.iter().filter(|(c, d)| (place - *c).dot(*d) < 0.0).count() as f64;
    let off = axes.iter().map(|(c, d)| (across(*d) * (place - *c)).length()).sum::<f64>();
    let way = axes.iter().map(|(c, _)| c.distance(place)).sum::<f64>();
    behind >= MOST * n && off < MEET * way
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_that_look_away_from_where_their_axes_meet_are_told_from_those_that_look_at_it() {
        let ring = |sign: f64| -> Vec<(DVec3, DVec3)> {
            (0..12)
                .map(|i| {
                    let at = DVec3::new((0.5 * f64::from(i)).cos(), (0.5 * f64::from(i)).sin(), 0.4) * 3.0;
                    (at, (DVec3::new(0.1, 0.0, 0.0) - at).normalize() * sign)
                })
                .collect()
        };
        assert!(look_away(&ring(-1.0)) && !look_away(&ring(1.0)));
        let mut half = ring(1.0);
        half[6..].iter_mut().for_each(|a| a.1 = -a.1);
        assert!(!look_away(&half));
        // A survey straight down.
        let down: Vec<_> = (0..12).map(|i| (DVec3::new(f64::from(i), 0.0, 40.0), -DVec3::Z)).collect();
        assert!(!look_away(&down) && !look_away(&ring(-1.0)[..2]));
    }
}
