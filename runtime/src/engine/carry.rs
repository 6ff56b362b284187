//! What a rebuilt model keeps of the one trained so far.
//!
//! New key frames bring new ground. Where the trained model already stands its Gaussians are better than fresh ones;
//! elsewhere the fresh ones fill the gap. A cell that holds a trained Gaussian takes no fresh one, so nothing is doubled.

use std::collections::HashSet;

use models::cloud::GaussianCloud;

/// Share of the trained Gaussians given up for new ground; beyond it holes would be left where they stood.
const MOST_GIVEN_UP: f64 = 0.4;

type Cell = [i32; 3];

fn cell(mean: [f32; 3], edge_m: f32) -> Cell {
    mean.map(|v| (v / edge_m).floor().clamp(-1e9, 1e9) as i32)
}

/// `trained` plus those of `fresh` that stand in cells (edge `edge_m`, metres) without a trained Gaussian, at most
/// `capacity` in all. Where that is too few for both, new ground gets what it has in `fresh`, whose Gaussians are spread evenly,
/// and the trained ones that cover least go; when more would go than [`MOST_GIVEN_UP`], everything starts anew. Returns how many
/// fresh ones there are.
pub fn carry_over(trained: &mut GaussianCloud, fresh: &GaussianCloud, edge_m: f32, capacity: usize) -> usize {
    if trained.is_empty() || edge_m.is_nan() || edge_m <= 0.0 {
        trained.clone_from(fresh);
        return trained.len();
    }
    // Opacity below 1/20 hides nothing: such a Gaussian does not claim its cell.
    let claims = |logit: f32| logit > -2.94;
    let taken: HashSet<Cell> = trained
        .means
        .iter()
        .zip(&trained.opacity_logits)
        .filter(|(_, o)| claims(**o))
        .map(|(m, _)| cell(*m, edge_m))
        .collect();
    let mut new = fresh.clone();
    new.retain(|i| !taken.contains(&cell(fresh.means[i], edge_m)));
    let room = capacity.saturating_sub(new.len());
    if trained.len() > room {
        if (room as f64) < (1.0 - MOST_GIVEN_UP) * trained.len() as f64 {
            trained.clone_from(fresh);
            return trained.len();
        }
        let keep = trained.most_covering(room);
        trained.retain(|i| keep[i]);
    }
    trained.extend(&new);
    new.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(xs: &[f32]) -> GaussianCloud {
        let mut c = GaussianCloud::with_capacity(0, xs.len());
        for x in xs {
            c.push([*x, 0.0, 0.0], [-3.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.0; 3]);
        }
        c
    }

    #[test]
    fn covered_ground_keeps_its_trained_gaussians_and_new_ground_gets_fresh_ones() {
        let mut trained = cloud(&[0.1, 1.1]);
        assert_eq!(carry_over(&mut trained, &cloud(&[0.2, 1.9, 2.5, 7.0]), 1.0, 100), 2);
        assert_eq!(trained, cloud(&[0.1, 1.1, 2.5, 7.0]));
    }

    #[test]
    fn new_ground_gets_its_share_of_the_cap_and_an_empty_model_takes_everything() {
        let mut trained = cloud(&[0.1, 0.2, 0.3, 0.4, 0.5]);
        trained.log_scales[1] = [-5.0; 3];
        assert_eq!(carry_over(&mut trained, &cloud(&[0.3, 7.0]), 1.0, 5), 1);
        assert_eq!(trained, cloud(&[0.1, 0.3, 0.4, 0.5, 7.0]), "the one that covers least made room");
        // More new ground than known: the known one would be left with holes.
        assert_eq!(carry_over(&mut trained, &cloud(&[0.3, 9.0, 10.0, 11.0]), 1.0, 5), 4);
        assert_eq!(trained, cloud(&[0.3, 9.0, 10.0, 11.0]));
        let mut empty = cloud(&[]);
        assert_eq!(carry_over(&mut empty, &cloud(&[5.0, 6.0]), 1.0, 3), 2);
    }

    #[test]
    fn transparent_gaussians_do_not_claim_their_cell() {
        let mut trained = cloud(&[0.1]);
        trained.opacity_logits[0] = -6.0;
        assert_eq!(carry_over(&mut trained, &cloud(&[0.2]), 1.0, 10), 1);
    }
}
