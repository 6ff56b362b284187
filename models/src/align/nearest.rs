//! Exact nearest neighbours of 3D points: an implicit kd-tree (the median sits in the middle of its slice), one
//! index per point and nothing else.

use glam::Vec3;

/// Slices of this length are searched one by one.
const LEAF: usize = 8;

/// A kd-tree over points that it borrows.
#[derive(Debug)]
pub struct KdTree<'a> {
    points: &'a [Vec3],
    order: Vec<u32>,
    axes: Vec<u8>,
}

impl<'a> KdTree<'a> {
    /// Builds the tree; points that are not finite are left out and never found.
    pub fn new(points: &'a [Vec3]) -> Self {
        let mut order: Vec<u32> = (0..points.len() as u32).filter(|&i| points[i as usize].is_finite()).collect();
        let mut axes = vec![0u8; order.len()];
        build(points, &mut order, &mut axes);
        Self { points, order, axes }
    }

    /// The `out.len()` points nearest to `query`, nearest first, as (squared distance, index); returns how many
    /// there are. `skip` is left out (a point's own index).
    pub fn nearest(&self, query: Vec3, skip: Option<u32>, out: &mut [(f32, u32)]) -> usize {
        let mut found = 0;
        if !out.is_empty() && query.is_finite() {
            self.search(0, self.order.len(), query, skip, out, &mut found);
        }
        found
    }

    fn search(&self, lo: usize, hi: usize, q: Vec3, skip: Option<u32>, out: &mut [(f32, u32)], found: &mut usize) {
        if hi - lo <= LEAF {
            for &i in &self.order[lo..hi] {
                self.offer(i, q, skip, out, found);
            }
            return;
        }
        let mid = (lo + hi) / 2;
        let axis = self.axes[mid] as usize;
        let delta = q[axis] - self.points[self.order[mid] as usize][axis];
        let (near, far) = if delta < 0.0 { ((lo, mid), (mid + 1, hi)) } else { ((mid + 1, hi), (lo, mid)) };
        self.search(near.0, near.1, q, skip, out, found);
        self.offer(self.order[mid], q, skip, out, found);
        if *found < out.len() || delta * delta < out[*found - 1].0 {
            self.search(far.0, far.1, q, skip, out, found);
        }
    }

    fn offer(&self, i: u32, q: Vec3, skip: Option<u32>, out: &mut [(f32, u32)], found: &mut usize) {
        if Some(i) == skip {
            return;
        }
        let d = self.points[i as usize].distance_squared(q);
        if *found == out.len() && d >= out[*found - 1].0 {
            return;
        }
        let mut at = if *found < out.len() { *found } else { *found - 1 };
        while at > 0 && out[at - 1].0 > d {
            out[at] = out[at - 1];
            at -= 1;
        }
        out[at] = (d, i);
        *found = (*found + 1).min(out.len());
    }
}

fn build(points: &[Vec3], order: &mut [u32], axes: &mut [u8]) {
    if order.len() <= LEAF {
        return;
    }
    let (mut lo, mut hi) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for &i in order.iter() {
        lo = lo.min(points[i as usize]);
        hi = hi.max(points[i as usize]);
    }
    let size = hi - lo;
    let axis = if size.x >= size.y && size.x >= size.z { 0 } else { usize::from(size.y < size.z) + 1 };
    let mid = order.len() / 2;
    order.select_nth_unstable_by(mid, |&a, &b| {
        points[a as usize][axis].total_cmp(&points[b as usize][axis]).then(a.cmp(&b))
    });
    axes[mid] = axis as u8;
    let (left, right) = order.split_at_mut(mid);
    let (left_axes, right_axes) = axes.split_at_mut(mid);
    build(points, left, left_axes);
    build(points, &mut right[1..], &mut right_axes[1..]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn finds_what_a_full_search_finds(
            raw in prop::collection::vec(prop::array::uniform3(-4i8..4), 1..200), q in prop::array::uniform3(-5.0f32..5.0)
        ) {
            // Small integers: many duplicates and ties.
            let points: Vec<Vec3> = raw.iter().map(|p| Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32)).collect();
            let tree = KdTree::new(&points);
            let mut out = [(0.0, 0); 4];
            let n = tree.nearest(q.into(), Some(0), &mut out);
            let mut all: Vec<f32> = points[1..].iter().map(|p| p.distance_squared(q.into())).collect();
            all.sort_by(f32::total_cmp);
            prop_assert_eq!(n, all.len().min(4));
            for k in 0..n {
                prop_assert_eq!(out[k].0, all[k]);
            }
        }
    }

    #[test]
    fn points_that_are_not_finite_are_never_found() {
        let points = [Vec3::NAN, Vec3::ZERO, Vec3::new(f32::INFINITY, 0.0, 0.0)];
        let tree = KdTree::new(&points);
        let mut out = [(0.0, 9); 3];
        assert_eq!(tree.nearest(Vec3::ONE, None, &mut out), 1);
        assert_eq!(out[0].1, 1);
        assert_eq!(tree.nearest(Vec3::NAN, None, &mut out), 0);
    }
}
