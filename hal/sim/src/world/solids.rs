//! Houses, cars and trees: convex solids that a ray meets in closed form, found through a uniform grid.

use glam::{DVec2, DVec3};

use super::terrain::Terrain;

/// Side of a grid cell, metres: about one house.
const CELL: f64 = 8.0;

/// Form of a solid. Heights are metres above its base.
#[derive(Clone, Copy, Debug)]
pub enum Form {
    /// Upright box with a gable roof whose ridge runs along the local x axis; flat when `ridge == eave`.
    Prism { half: DVec2, eave: f64, ridge: f64 },
    /// Axis-aligned ellipsoid around `centre` above the base: a broad-leaved crown, a bale.
    Ellipsoid { radius: f64, half_height: f64, centre: f64 },
    /// Cone with its tip up: a conifer.
    Cone { radius: f64, bottom: f64, top: f64 },
}

/// What the surface of a solid is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Material {
    /// Walls with windows under a roof.
    House,
    /// Painted metal with dark glass.
    Car,
    /// Leaves or needles.
    Leaves,
    /// Straw.
    Straw,
}

/// One thing standing on the ground.
#[derive(Clone, Copy, Debug)]
pub struct Solid {
    /// Form.
    pub form: Form,
    /// Material.
    pub material: Material,
    /// Base point, world metres.
    pub base: DVec3,
    /// Direction of the local x axis in the ground plane (unit).
    pub axis: DVec2,
    /// Base colour, 0..1.
    pub colour: [f32; 3],
    /// Seed of its textures.
    pub seed: u32,
}

/// Where a ray met a solid.
#[derive(Clone, Copy, Debug)]
pub struct SolidHit {
    /// Ray parameter.
    pub t: f64,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Index of the solid.
    pub index: u32,
}

impl Solid {
    /// Largest distance of any of its points from the base, seen from above.
    fn reach(&self) -> f64 {
        match self.form {
            Form::Prism { half, .. } => half.length(),
            Form::Ellipsoid { radius, .. } | Form::Cone { radius, .. } => radius,
        }
    }

    /// Height of its highest point above z = 0.
    fn top(&self) -> f64 {
        self.base.z
            + match self.form {
                Form::Prism { ridge, eave, .. } => ridge.max(eave),
                Form::Ellipsoid { half_height, centre, .. } => centre + half_height,
                Form::Cone { top, .. } => top,
            }
    }

    /// World → local: x along the axis, z up from the base.
    pub fn local(&self, p: DVec3) -> DVec3 {
        let q = p - self.base;
        DVec3::new(q.x * self.axis.x + q.y * self.axis.y, q.y * self.axis.x - q.x * self.axis.y, q.z)
    }

    /// First parameter in (`from`, `to`) at which the ray enters this solid, with the outward normal.
    #[inline]
    fn hit(&self, origin: DVec3, direction: DVec3, from: f64, to: f64) -> Option<(f64, DVec3)> {
        match self.form {
            Form::Prism { half, eave, ridge } => self.hit_prism(origin, direction, (from, to), half, eave, ridge),
            Form::Ellipsoid { radius, half_height, centre } => {
                let scale = DVec3::new(1.0 / radius, 1.0 / radius, 1.0 / half_height);
                let o = (origin - self.base - DVec3::Z * centre) * scale;
                let d = direction * scale;
                let (a, b, c) = (d.length_squared(), o.dot(d), o.length_squared() - 1.0);
                let disc = b * b - a * c;
                if disc <= 0.0 {
                    return None;
                }
                let t = (-b - disc.sqrt()) / a;
                (t > from && t < to).then(|| (t, ((o + t * d) * scale).normalize()))
            }
            Form::Cone { radius, bottom, top } => {
                // x² + y² = (k·(tip − z))² with the tip at the origin of o.
                let k = radius / (top - bottom);
                let o = origin - self.base - DVec3::Z * top;
                let d = direction;
                let a = d.x * d.x + d.y * d.y - k * k * d.z * d.z;
                let b = o.x * d.x + o.y * d.y - k * k * o.z * d.z;
                let c = o.x * o.x + o.y * o.y - k * k * o.z * o.z;
                let disc = b * b - a * c;
                if disc <= 0.0 || a.abs() < 1e-15 {
                    return None;
                }
                let root = disc.sqrt();
                let (t1, t2) = ((-b - root) / a, (-b + root) / a);
                let t = [t1.min(t2), t1.max(t2)].into_iter().find(|t| {
                    let z = o.z + t * d.z;
                    *t > from && *t < to && z <= 0.0 && z >= bottom - top
                })?;
                let p = o + t * d;
                Some((t, DVec3::new(p.x, p.y, -k * k * p.z).normalize()))
            }
        }
    }

    /// Clipping the ray by the planes of a convex solid.
    fn hit_prism(
        &self,
        origin: DVec3,
        direction: DVec3,
        (from, to): (f64, f64),
        half: DVec2,
        eave: f64,
        ridge: f64,
    ) -> Option<(f64, DVec3)> {
        let o = self.local(origin);
        let d = DVec3::new(
            direction.x * self.axis.x + direction.y * self.axis.y,
            direction.y * self.axis.x - direction.x * self.axis.y,
            direction.z,
        );
        let (mut enter, mut leave, mut face) = (f64::NEG_INFINITY, to, DVec3::Z);
        let slope = (ridge - eave) / half.y;
        let planes = [
            (DVec3::X, half.x),
            (DVec3::NEG_X, half.x),
            (DVec3::Y, half.y),
            (DVec3::NEG_Y, half.y),
            (DVec3::new(0.0, slope, 1.0), ridge),
            (DVec3::new(0.0, -slope, 1.0), ridge),
        ];
        for (n, limit) in planes {
            let (speed, gap) = (n.dot(d), limit - n.dot(o));
            if speed.abs() < 1e-14 {
                if gap < 0.0 {
                    return None;
                }
                continue;
            }
            let t = gap / speed;
            if speed < 0.0 {
                if t > enter {
                    (enter, face) = (t, n);
                }
            } else if t < leave {
                leave = t;
            }
            if enter >= leave {
                return None;
            }
        }
        if enter <= from || enter >= to {
            return None;
        }
        let n = face.normalize();
        let n = DVec3::new(n.x * self.axis.x - n.y * self.axis.y, n.x * self.axis.y + n.y * self.axis.x, n.z);
        Some((enter, n))
    }
}

/// All solids of a world, with a grid to find them.
pub struct Solids {
    all: Vec<Solid>,
    half: f64,
    n: usize,
    /// Start of each cell's list in `items`; one more than there are cells.
    starts: Vec<u32>,
    items: Vec<u32>,
    /// Highest top in each cell.
    tops: Vec<f32>,
    high: f64,
}

impl Solids {
    /// Sorts solids into the grid over the terrain's square.
    pub fn new(all: Vec<Solid>, terrain: &Terrain) -> Self {
        let half = terrain.half() + 2.0 * CELL;
        let n = (2.0 * half / CELL).ceil() as usize;
        let mut cells: Vec<Vec<u32>> = vec![Vec::new(); n * n];
        let mut tops = vec![f32::NEG_INFINITY; n * n];
        for (index, s) in all.iter().enumerate() {
            let r = s.reach();
            let clamp = |a: f64| ((a + half) / CELL).clamp(0.0, (n - 1) as f64) as usize;
            for j in clamp(s.base.y - r)..=clamp(s.base.y + r) {
                for i in clamp(s.base.x - r)..=clamp(s.base.x + r) {
                    cells[j * n + i].push(index as u32);
                    tops[j * n + i] = tops[j * n + i].max(s.top() as f32 + 0.01);
                }
            }
        }
        let mut starts = vec![0u32];
        let mut items = Vec::new();
        for cell in cells {
            items.extend(cell);
            starts.push(items.len() as u32);
        }
        let high = all.iter().fold(f64::NEG_INFINITY, |h, s| h.max(s.top()));
        Self { all, half, n, starts, items, tops, high }
    }

    /// The solid at an index of [`SolidHit`].
    pub fn get(&self, index: u32) -> &Solid {
        &self.all[index as usize]
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.all.len()
    }

    /// The first solid met for t in (`from`, `to`); any of them when `any` is set (a shadow needs no more).
    pub fn hit(&self, origin: DVec3, direction: DVec3, from: f64, to: f64, any: bool) -> Option<SolidHit> {
        let (mut enter, mut leave) = (from, to);
        // Nothing stands above the highest top.
        if direction.z.abs() > 1e-12 {
            let t = (self.high - origin.z) / direction.z;
            if direction.z < 0.0 { enter = enter.max(t) } else { leave = leave.min(t) }
        } else if origin.z > self.high {
            return None;
        }
        for axis in 0..2 {
            if direction[axis].abs() < 1e-12 {
                if origin[axis].abs() > self.half {
                    return None;
                }
                continue;
            }
            let (a, b) = ((-self.half - origin[axis]) / direction[axis], (self.half - origin[axis]) / direction[axis]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        if enter >= leave {
            return None;
        }
        let start = (origin.truncate() + enter * direction.truncate() + DVec2::splat(self.half)) / CELL;
        let last = (self.n - 1) as f64;
        let (mut i, mut j) = (start.x.clamp(0.0, last) as i64, start.y.clamp(0.0, last) as i64);
        let next = |cell: i64, o: f64, d: f64| {
            if d.abs() < 1e-12 {
                f64::INFINITY
            } else {
                ((cell + i64::from(d > 0.0)) as f64 * CELL - self.half - o) / d
            }
        };
        let delta = |d: f64| if d.abs() < 1e-12 { f64::INFINITY } else { CELL / d.abs() };
        let (mut ti, mut tj) = (next(i, origin.x, direction.x), next(j, origin.y, direction.y));
        let (di, dj) = (delta(direction.x), delta(direction.y));
        let mut best: Option<SolidHit> = None;
        let mut t = enter;
        while i >= 0 && j >= 0 && (i as usize) < self.n && (j as usize) < self.n && t < leave {
            let cell = j as usize * self.n + i as usize;
            let out = ti.min(tj).min(leave);
            let lowest = origin.z + direction.z * if direction.z < 0.0 { out } else { t };
            if lowest <= f64::from(self.tops[cell]) {
                for &index in &self.items[self.starts[cell] as usize..self.starts[cell + 1] as usize] {
                    let limit = best.map_or(to, |b| b.t);
                    if let Some((t, normal)) = self.all[index as usize].hit(origin, direction, from, limit) {
                        best = Some(SolidHit { t, normal, index });
                        if any {
                            return best;
                        }
                    }
                }
            }
            if best.is_some_and(|b| b.t <= out) {
                return best;
            }
            t = out;
            if ti < tj {
                i += if direction.x > 0.0 { 1 } else { -1 };
                ti += di;
            } else {
                j += if direction.y > 0.0 { 1 } else { -1 };
                tj += dj;
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(form: Form) -> Solids {
        let solid = Solid {
            form,
            material: Material::House,
            base: DVec3::new(3.0, -2.0, 1.0),
            axis: DVec2::from_angle(0.4),
            colour: [0.5; 3],
            seed: 1,
        };
        Solids::new(vec![solid], &Terrain::new(0, 60.0, 0.0))
    }

    #[test]
    fn a_ray_from_above_meets_roof_crown_and_tip_at_their_heights() {
        let cases = [
            (Form::Prism { half: DVec2::new(5.0, 4.0), eave: 3.0, ridge: 5.0 }, 6.0),
            (Form::Ellipsoid { radius: 2.0, half_height: 1.5, centre: 4.0 }, 6.5),
            (Form::Cone { radius: 2.0, bottom: 1.0, top: 9.0 }, 10.0 - 4.0 * 0.001),
        ];
        for (form, z) in cases {
            let world = one(form);
            let hit = world.hit(DVec3::new(3.001, -2.0, 50.0), DVec3::NEG_Z, 0.0, 60.0, false).expect("hit");
            assert!((50.0 - hit.t - z).abs() < 1e-3, "{form:?}: {}", 50.0 - hit.t);
            assert!(hit.normal.z > 0.0 && (hit.normal.length() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn the_grid_finds_what_a_search_of_all_solids_finds() {
        let mut all = Vec::new();
        for k in 0..60 {
            let a = f64::from(k);
            let form = match k % 3 {
                0 => Form::Prism { half: DVec2::new(3.0, 2.0), eave: 3.0, ridge: 4.0 },
                1 => Form::Ellipsoid { radius: 2.0, half_height: 2.0, centre: 3.0 },
                _ => Form::Cone { radius: 1.5, bottom: 0.5, top: 8.0 },
            };
            let base = DVec3::new(45.0 * (a * 2.4).sin(), 45.0 * (a * 1.7).cos(), 0.0);
            all.push(Solid {
                form,
                material: Material::Leaves,
                base,
                axis: DVec2::from_angle(a),
                colour: [0.5; 3],
                seed: 0,
            });
        }
        let grid = Solids::new(all.clone(), &Terrain::new(0, 60.0, 0.0));
        let mut met = 0;
        for k in 0..3_000 {
            let a = f64::from(k) * 0.61;
            let origin = DVec3::new(50.0 * a.sin(), 50.0 * (0.7 * a).cos(), 3.0 + 30.0 * (a * 0.3).sin().abs());
            let direction = DVec3::new((a * 1.1).cos(), (a * 1.1).sin(), -0.9 * (a * 0.9).sin().abs());
            let brute =
                all.iter().filter_map(|s| s.hit(origin, direction, 1e-6, 200.0)).map(|h| h.0).min_by(f64::total_cmp);
            let found = grid.hit(origin, direction, 1e-6, 200.0, false).map(|h| h.t);
            assert_eq!(brute, found, "ray {k}");
            met += usize::from(found.is_some());
        }
        assert!(met > 300, "{met} rays met something");
    }
}
