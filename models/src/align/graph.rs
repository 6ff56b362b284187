//! The connectivity graph of the paper: pictures are vertices, an edge is a pair that a network has looked at, and its
//! two pointmaps are in the first camera's frame at an unknown scale of their own.

use glam::Vec3;

/// One picture's points as one edge predicts them.
#[derive(Clone, Debug)]
pub struct PointMap {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// In the first camera's frame, up to the edge's scale; row-major.
    pub points: Vec<Vec3>,
    /// Weight from 0; 0 or not finite = no opinion.
    pub confidence: Vec<f32>,
}

impl PointMap {
    /// The point and confidence at `at` when both are finite and the confidence is positive.
    pub fn get(&self, at: usize) -> Option<(Vec3, f32)> {
        let (p, c) = (self.points[at], self.confidence[at]);
        (p.is_finite() && c.is_finite() && c > 0.0).then_some((p, c))
    }
}

/// A pair: pointmaps of both pictures in the first one's frame.
#[derive(Clone, Debug)]
pub struct Edge {
    /// Index of the first picture, whose camera is the frame.
    pub first: usize,
    /// Index of the second picture.
    pub second: usize,
    /// X^{p,p} and X^{q,p}.
    pub maps: [PointMap; 2],
}

impl Edge {
    /// The two (picture, pointmap) of the edge.
    pub fn views(&self) -> [(usize, &PointMap); 2] {
        [(self.first, &self.maps[0]), (self.second, &self.maps[1])]
    }
}

/// For each of `pictures` the number of its connected component, and how many components have at least one edge.
pub fn components(pictures: usize, edges: &[Edge]) -> (Vec<usize>, usize) {
    let mut label: Vec<usize> = (0..pictures).collect();
    fn root(label: &mut [usize], mut i: usize) -> usize {
        while label[i] != i {
            label[i] = label[label[i]];
            i = label[i];
        }
        i
    }
    for e in edges.iter().filter(|e| e.first < pictures && e.second < pictures) {
        let (a, b) = (root(&mut label, e.first), root(&mut label, e.second));
        label[a.max(b)] = a.min(b);
    }
    for i in 0..pictures {
        label[i] = root(&mut label, i);
    }
    let mut used: Vec<usize> = edges.iter().filter(|e| e.first < pictures).map(|e| label[e.first]).collect();
    used.sort_unstable();
    used.dedup();
    (label, used.len())
}
