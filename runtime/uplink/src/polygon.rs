//! How far a place lies from a polygon.

use glam::DVec2;

/// Metres from `p` to the polygon of these corners; 0 inside (even-odd rule, so concave polygons work). One or two corners are a
/// point and a line.
pub fn distance(corners: &[DVec2], p: DVec2) -> f64 {
    let mut inside = false;
    let mut nearest = f64::INFINITY;
    for (i, &a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % corners.len()];
        let (edge, to) = (b - a, p - a);
        let along =
            if edge.length_squared() > 0.0 { (to.dot(edge) / edge.length_squared()).clamp(0.0, 1.0) } else { 0.0 };
        nearest = nearest.min((to - edge * along).length());
        if (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x) {
            inside = !inside;
        }
    }
    if inside { 0.0 } else { nearest }
}
