//! A start that outliers do not move: each edge's σ as the weighted median of what its single pixels say through the
//! known baseline; edges without a baseline get theirs from the pictures they share with others.

use nalgebra::DVector;

use super::{Pixel, Term};

/// Parallax (baseline across the ray ÷ distance) below which a pixel says nothing about σ.
const MIN_PARALLAX: f64 = 0.01;
/// Pixels an edge needs.
const MIN_PIXELS: usize = 12;

/// The value at which half the weight lies on either side.
fn weighted_median(values: &mut [(f64, f64)]) -> Option<f64> {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = values.iter().map(|v| v.1).sum();
    let mut so_far = 0.0;
    values
        .iter()
        .find(|v| {
            so_far += v.1;
            so_far >= 0.5 * total
        })
        .map(|v| v.0)
}

/// σ of every edge, and which edges have one.
pub fn sigma(terms: &[Term], pixels: &[Pixel], usable: &[bool], edges: usize) -> (DVector<f64>, Vec<bool>) {
    let mut votes: Vec<Vec<(f64, f64)>> = vec![Vec::new(); edges];
    for pixel in pixels {
        for term in &terms[pixel.terms.clone()] {
            let (a, b) = (term.a.reject_from_normalized(pixel.ray), term.b.reject_from_normalized(pixel.ray));
            let value = -a.dot(b) / a.length_squared();
            // Too little parallax: noise across the ray would vote.
            if value > 0.0 && value.is_finite() && b.length() > MIN_PARALLAX * value * term.a.length() {
                votes[term.edge].push((value, term.confidence * b.length()));
            }
        }
    }
    let mut found = DVector::zeros(edges);
    let mut alive = vec![false; edges];
    for e in (0..edges).filter(|&e| usable[e]) {
        if votes[e].len() >= MIN_PIXELS
            && let Some(s) = weighted_median(&mut votes[e])
        {
            found[e] = s;
            alive[e] = true;
        }
    }
    while spread(terms, pixels, usable, &mut found, &mut alive) {}
    (found, alive)
}

/// Gives σ to edges that share pixels with edges that have one; false when nothing was left to do.
fn spread(terms: &[Term], pixels: &[Pixel], usable: &[bool], found: &mut DVector<f64>, alive: &mut [bool]) -> bool {
    let mut votes: Vec<Vec<(f64, f64)>> = vec![Vec::new(); alive.len()];
    for pixel in pixels {
        let known = depth(terms, pixel, found, alive);
        for term in &terms[pixel.terms.clone()] {
            let along = term.a.dot(pixel.ray);
            if known > 0.0 && !alive[term.edge] && usable[term.edge] && along > 0.0 {
                votes[term.edge].push(((known - term.b.dot(pixel.ray)) / along, term.confidence));
            }
        }
    }
    let mut any = false;
    for (e, votes) in votes.iter_mut().enumerate() {
        if votes.len() >= MIN_PIXELS
            && let Some(s) = weighted_median(votes).filter(|s| *s > 0.0)
        {
            found[e] = s;
            alive[e] = true;
            any = true;
        }
    }
    any
}

/// Weighted median of a pixel's distances along its ray; 0 when no edge with a σ sees it.
pub fn depth(terms: &[Term], pixel: &Pixel, sigma: &DVector<f64>, alive: &[bool]) -> f64 {
    let mut opinions: Vec<(f64, f64)> = terms[pixel.terms.clone()]
        .iter()
        .filter(|t| alive[t.edge])
        .map(|t| ((t.b + t.a * sigma[t.edge]).dot(pixel.ray), t.confidence))
        .filter(|o| o.0 > 0.0)
        .collect();
    weighted_median(&mut opinions).unwrap_or(0.0)
}
