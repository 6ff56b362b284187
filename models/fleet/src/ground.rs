//! Ground in metres east and north: polygons with holes, and what two of them have in common.

use geometry::polygon;
use glam::DVec2;
use i_overlay::core::fill_rule::FillRule;
use i_overlay::core::overlay_rule::OverlayRule;
use i_overlay::float::single::SingleFloatOverlay;

use crate::FleetError;

/// Corners in order; the last is joined to the first.
pub type Ring = Vec<DVec2>;

/// Most corners of an area, holes included.
pub const MOST_CORNERS: usize = 4096;
/// Most ground of one plan, square metres (100 km²), and its extent, metres: plans end 10 km from the mission's origin.
const MOST_M2: f64 = 1e8;
const MOST_EXTENT_M: f64 = 20_000.0;
/// The least, square metres: what a mission takes for a region.
const LEAST_M2: f64 = 100.0;
/// Share of an area that rounding may take or add.
const ROUNDING: f64 = 1e-6;
/// Parts smaller than this are rounding, square metres.
const DUST_M2: f64 = 1e-3;

/// Polygons that do not overlap: outsides counter-clockwise, holes clockwise.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ground {
    /// Outside and holes of each.
    pub parts: Vec<Vec<Ring>>,
}

type Flat = Vec<Vec<[f64; 2]>>;

impl Ground {
    /// One polygon without what is cut out of it.
    ///
    /// # Errors
    /// Sides that cross each other, nothing left, more than one part left, larger or with more corners than can be planned.
    pub fn new(outside: Ring, cut: &[Ring]) -> Result<Self, FleetError> {
        let wrong = |why: String| Err(FleetError::Area(why));
        let corners = outside.len() + cut.iter().map(Vec::len).sum::<usize>();
        if corners > MOST_CORNERS {
            return wrong(format!("has {corners} corners; {MOST_CORNERS} can be planned, so draw it simpler"));
        }
        if !outside.iter().chain(cut.iter().flatten()).all(|p| p.is_finite()) {
            return wrong("has a corner that is no number".into());
        }
        let mut ground = Self { parts: Vec::new() };
        for (k, ring) in std::iter::once(&outside).chain(cut).enumerate() {
            let simple = Self::of(vec![ring.clone()]);
            let (drawn, enclosed) = (polygon::signed_area(ring).abs(), simple.area_m2());
            let whole = simple.parts.len() == 1 && simple.parts[0].len() == 1;
            if enclosed < DUST_M2 || ring.len() < 3 {
                return wrong("has a ring without an area".into());
            }
            if !whole || (drawn - enclosed).abs() > ROUNDING * enclosed {
                return wrong("has sides that cross each other; draw its corners in order".into());
            }
            ground = if k == 0 { simple } else { ground.overlaid(&simple, OverlayRule::Difference) };
        }
        match ground.parts.len() {
            0 => return wrong("is empty: its holes leave nothing of it".into()),
            1 => {}
            parts => return wrong(format!("falls into {parts} parts by what is cut out; plan each by itself")),
        }
        ground.checked()
    }

    /// Several polygons, those that overlap joined.
    ///
    /// # Errors
    /// Nothing, or more than can be planned.
    pub fn joined(rings: Vec<Ring>) -> Result<Self, FleetError> {
        let corners = rings.iter().map(Vec::len).sum::<usize>();
        if corners > MOST_CORNERS {
            return Err(FleetError::Area(format!("has {corners} corners; {MOST_CORNERS} can be planned")));
        }
        let flat = flat(&rings);
        Self::from_shapes(flat.overlay_as::<i64>(&Flat::new(), OverlayRule::Subject, FillRule::NonZero)).checked()
    }

    fn checked(self) -> Result<Self, FleetError> {
        let wrong = |why: String| Err(FleetError::Area(why));
        let (area, [low, high]) = (self.area_m2(), self.bounds());
        if area.is_nan() || area < LEAST_M2 {
            return wrong(format!("has {area:.1} m²; at least {LEAST_M2:.0} can be planned"));
        }
        let extent = (high - low).max_element();
        if area > MOST_M2 || extent > MOST_EXTENT_M {
            return wrong(format!(
                "has {:.1} km² and reaches over {:.1} km; at most {:.0} km² within {:.0} km can be planned",
                area / 1e6,
                extent / 1e3,
                MOST_M2 / 1e6,
                MOST_EXTENT_M / 1e3
            ));
        }
        Ok(self)
    }

    /// What lies inside an odd number of rings.
    pub fn of(rings: Vec<Ring>) -> Self {
        let flat = flat(&rings);
        Self::from_shapes(flat.overlay_as::<i64>(&Flat::new(), OverlayRule::Subject, FillRule::EvenOdd))
    }

    /// What lies inside of any ring.
    pub fn covered_by(mut rings: Vec<Ring>) -> Self {
        // Rings of both directions would take each other away.
        rings.iter_mut().filter(|ring| polygon::signed_area(ring) < 0.0).for_each(|ring| ring.reverse());
        let flat = flat(&rings);
        Self::from_shapes(flat.overlay_as::<i64>(&Flat::new(), OverlayRule::Subject, FillRule::NonZero))
    }

    /// What lies in this and in `other`.
    pub fn common(&self, other: &Self) -> Self {
        self.overlaid(other, OverlayRule::Intersect)
    }

    /// What lies in this and not in `other`.
    pub fn without(&self, other: &Self) -> Self {
        self.overlaid(other, OverlayRule::Difference)
    }

    /// What lies in this, in `other`, or in both.
    pub fn with(&self, other: &Self) -> Self {
        self.overlaid(other, OverlayRule::Union)
    }

    fn overlaid(&self, other: &Self, rule: OverlayRule) -> Self {
        let [a, b] = [self, other].map(|g| flat_of(g.rings()));
        Self::from_shapes(a.overlay_as::<i64>(&b, rule, FillRule::EvenOdd))
    }

    fn from_shapes(shapes: Vec<Flat>) -> Self {
        let ring = |ring: Vec<[f64; 2]>| ring.into_iter().map(DVec2::from).collect::<Ring>();
        let parts = shapes.into_iter().map(|shape| shape.into_iter().map(ring).collect::<Vec<_>>());
        let whole = |part: &Vec<Ring>| part.first().is_some_and(|outside| polygon::signed_area(outside) > DUST_M2);
        Self { parts: parts.filter(whole).collect() }
    }

    /// All rings.
    pub fn rings(&self) -> impl Iterator<Item = &Ring> {
        self.parts.iter().flatten()
    }

    /// Area, square metres.
    pub fn area_m2(&self) -> f64 {
        self.rings().map(|ring| polygon::signed_area(ring)).sum()
    }

    /// South-western and north-eastern corner of the box around it.
    pub fn bounds(&self) -> [DVec2; 2] {
        let corners = self.rings().flatten();
        corners.fold([DVec2::INFINITY, DVec2::NEG_INFINITY], |[low, high], p| [low.min(*p), high.max(*p)])
    }

    /// Centre of gravity.
    pub fn middle(&self) -> DVec2 {
        let [low, _] = self.bounds();
        let (mut sum, mut area) = (DVec2::ZERO, 0.0);
        for ring in self.rings() {
            for (a, b) in ring.iter().zip(ring.iter().cycle().skip(1)) {
                let (a, b) = (*a - low, *b - low);
                let twice = a.perp_dot(b);
                (sum, area) = (sum + (a + b) * twice, area + 3.0 * twice);
            }
        }
        if area > 0.0 { low + sum / area } else { low }
    }

    /// Whether a point lies in it.
    pub fn contains(&self, p: DVec2) -> bool {
        self.rings().filter(|ring| polygon::contains(ring, p)).count() % 2 == 1
    }
}

fn flat(rings: &[Ring]) -> Flat {
    flat_of(rings.iter())
}

fn flat_of<'a>(rings: impl Iterator<Item = &'a Ring>) -> Flat {
    rings.map(|ring| ring.iter().map(|p| p.to_array()).collect()).collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A rectangle from its south-western corner.
    pub(crate) fn rectangle(x: f64, y: f64, width: f64, height: f64) -> Ring {
        [[x, y], [x + width, y], [x + width, y + height], [x, y + height]].map(DVec2::from).to_vec()
    }

    #[test]
    fn a_polygon_loses_what_is_cut_out_and_crossed_or_empty_ones_are_refused() {
        let square = rectangle(0.0, 0.0, 100.0, 100.0);
        let ground = Ground::new(square.clone(), &[rectangle(40.0, 40.0, 20.0, 20.0)]).expect("ground");
        assert!((ground.area_m2() - 9600.0).abs() < 1e-3 && ground.parts[0].len() == 2);
        assert!((ground.middle() - 50.0).length() < 1e-6, "{}", ground.middle());
        assert!(ground.contains(DVec2::new(10.0, 10.0)) && !ground.contains(DVec2::splat(50.0)));
        // What reaches out of it takes a bite.
        let bitten = Ground::new(square.clone(), &[rectangle(90.0, 40.0, 20.0, 20.0)]).expect("ground");
        assert!((bitten.area_m2() - 9800.0).abs() < 1e-3 && bitten.parts[0].len() == 1);
        let refused = |outside: Ring, cut: &[Ring]| Ground::new(outside, cut).expect_err("refused").to_string();
        let bow = [[0.0, 0.0], [100.0, 100.0], [100.0, 0.0], [0.0, 90.0]].map(DVec2::from).to_vec();
        assert!(refused(bow, &[]).contains("cross each other"));
        assert!(refused(square.clone(), &[rectangle(-1.0, -1.0, 200.0, 200.0)]).contains("leave nothing"));
        assert!(refused(square.clone(), &[rectangle(-1.0, 40.0, 200.0, 10.0)]).contains("2 parts"));
        assert!(refused(rectangle(0.0, 0.0, 9.0, 9.0), &[]).contains("at least 100"));
        assert!(refused(rectangle(0.0, 0.0, 30_000.0, 90.0), &[]).contains("30.0 km"));
        assert!(refused(vec![DVec2::new(f64::NAN, 0.0); 3], &[]).contains("no number"));
        assert!(refused(vec![DVec2::ZERO, DVec2::X, DVec2::X * 2.0], &[]).contains("without an area"));
        let many = (0..5000).map(|k| DVec2::from_angle(f64::from(k) * 1e-3) * 500.0).collect();
        assert!(refused(many, &[]).contains("5000 corners"));
    }
}
