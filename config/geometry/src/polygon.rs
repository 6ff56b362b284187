//! Polygons in the plane, as lists of corners in order; the last corner is joined to the first.

use glam::DVec2;

/// Area of a polygon: positive where its corners go counter-clockwise.
pub fn signed_area(corners: &[DVec2]) -> f64 {
    let Some(&first) = corners.first() else { return 0.0 };
    // Relative to a corner: coordinates of UTM's size would leave no digits for the area.
    sides(corners).map(|(p, q)| (p - first).perp_dot(q - first)).sum::<f64>() * 0.5
}

/// Length of a polygon's sides together.
pub fn perimeter(corners: &[DVec2]) -> f64 {
    sides(corners).map(|(p, q)| p.distance(q)).sum()
}

/// Whether a point lies inside a polygon (even-odd rule).
pub fn contains(corners: &[DVec2], p: DVec2) -> bool {
    crossings(corners, p.y).filter(|x| p.x < *x).count() % 2 == 1
}

/// Where the sides of a polygon cross a line of equal y, in no order.
pub fn crossings(corners: &[DVec2], y: f64) -> impl Iterator<Item = f64> {
    let crosses = move |(a, b): &(DVec2, DVec2)| (a.y > y) != (b.y > y);
    sides(corners).filter(crosses).map(move |(a, b)| a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x))
}

fn sides(corners: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    corners.iter().copied().zip(corners.iter().copied().cycle().skip(1))
}

/// Convex hull (Andrew's monotone chain), counter-clockwise; points that are no numbers are left out.
pub fn hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.retain(|p| p.is_finite());
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut hull: Vec<DVec2> = Vec::with_capacity(2 * points.len());
    let chain = |hull: &mut Vec<DVec2>, points: &mut dyn Iterator<Item = &DVec2>| {
        let start = hull.len();
        for &p in points {
            while hull.len() >= start + 2 {
                let (a, b) = (hull[hull.len() - 2], hull[hull.len() - 1]);
                if (b - a).perp_dot(p - b) > 0.0 {
                    break;
                }
                hull.pop();
            }
            hull.push(p);
        }
        hull.pop();
    };
    chain(&mut hull, &mut points.iter());
    chain(&mut hull, &mut points.iter().rev());
    hull
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(corner: DVec2, side: f64) -> Vec<DVec2> {
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|c| corner + side * DVec2::from(c)).to_vec()
    }

    #[test]
    fn a_square_far_from_zero_has_its_area_sides_and_inside() {
        let corner = DVec2::new(500_000.0, 5_400_000.0);
        let mut corners = square(corner, 0.01);
        assert!((signed_area(&corners) - 1e-4).abs() < 1e-10, "{}", signed_area(&corners));
        assert!((perimeter(&corners) - 0.04).abs() < 1e-8);
        assert!(contains(&corners, corner + 0.005) && !contains(&corners, corner - 0.005));
        corners.reverse();
        assert!(signed_area(&corners) < 0.0);
        assert_eq!((signed_area(&[]), perimeter(&[])), (0.0, 0.0));
    }

    #[test]
    fn hulls_of_few_or_equal_points_are_points_and_lines() {
        let p = DVec2::new(1.0, 2.0);
        assert_eq!(hull(vec![p, p, p]), vec![p]);
        let line = hull(vec![p, DVec2::new(3.0, 2.0), DVec2::new(2.0, 2.0), DVec2::new(f64::NAN, 0.0)]);
        assert_eq!(line, vec![p, DVec2::new(3.0, 2.0)]);
        let square = hull([[0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [1.0, 0.0], [0.4, 0.6]].map(DVec2::from).to_vec());
        assert_eq!(square.len(), 4);
    }
}
