//! What stands where: a grid of roads cuts the land into blocks, and each block's hash decides its use.

use glam::{DVec2, DVec3};

use super::noise::{hash, unit, unit2, wave};
use super::solids::{Form, Material, Solid};
use super::terrain::Terrain;

/// Distance between the centre lines of two roads, metres.
pub const BLOCK: f64 = 46.0;
/// Half the width of a road with its verges, metres.
pub const ROAD_HALF: f64 = 4.6;

/// Use of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Use {
    /// Houses in gardens.
    Houses,
    /// Lawn with trees and a ball court.
    Park,
    /// Rows of crops.
    Field,
    /// Marked bays, cars, one flat hall.
    CarPark,
    /// Dense trees.
    Wood,
}

/// Centre line of the k-th road running along y, at a given y (and the same for roads along x): not straight,
/// so that no two crossings look alike.
pub fn road_line(k: i32, along: f64, seed: u32) -> f64 {
    let h = hash(k, 77, seed);
    let jitter = f64::from(unit(h) - 0.5) * 9.0;
    f64::from(k) * BLOCK + jitter + 2.2 * wave(along * (1.0 / 195.0) + f64::from(unit2(h)))
}

/// The use of block (i, j); block (0, 0) lies between road 0 and road 1 in both directions.
pub fn block_use(i: i32, j: i32, seed: u32) -> Use {
    // Neighbouring blocks step through the uses, so that every region of a survey sees several of them.
    let turn = (i.wrapping_mul(2).wrapping_add(j.wrapping_mul(3)).rem_euclid(5)
        + (hash(i, j, seed ^ 0xB10C) % 2) as i32)
        .rem_euclid(5);
    [Use::Houses, Use::Park, Use::Field, Use::CarPark, Use::Wood][turn as usize]
}

/// Every solid of the world.
pub fn populate(terrain: &Terrain, seed: u32, density: f32) -> Vec<Solid> {
    let mut solids = Vec::new();
    let reach = (terrain.half() / BLOCK).ceil() as i32;
    for j in -reach..reach {
        for i in -reach..reach {
            let middle = DVec2::new((f64::from(i) + 0.5) * BLOCK, (f64::from(j) + 0.5) * BLOCK);
            if middle.abs().max_element() + BLOCK / 2.0 < terrain.half() {
                let mut block = Block { terrain, middle, state: hash(i, j, seed ^ 0x9B1), out: &mut solids };
                block.fill(block_use(i, j, seed), density);
            }
        }
    }
    solids
}

/// One block being filled.
struct Block<'a> {
    terrain: &'a Terrain,
    middle: DVec2,
    state: u32,
    out: &'a mut Vec<Solid>,
}

impl Block<'_> {
    /// The next number in 0..1 of this block.
    fn next(&mut self) -> f64 {
        self.state = hash(self.state as i32, 0x51ED, 0x2705);
        f64::from(unit(self.state))
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }

    /// Adds a solid unless its footprint (a disc) touches an earlier one's; true when it stands.
    fn add(&mut self, form: Form, material: Material, at: DVec2, angle: f64, colour: [f32; 3], reach: f64) -> bool {
        let free = |s: &Solid| {
            let other = match s.form {
                Form::Prism { half, .. } => half.length(),
                Form::Ellipsoid { radius, .. } | Form::Cone { radius, .. } => radius,
            };
            (s.base.truncate() - at).length() > 0.8 * (other + reach)
        };
        if self.out.iter().rev().take(60).any(|s| !free(s)) {
            return false;
        }
        // The lowest ground under the footprint, so that nothing floats.
        let z = (0..8).fold(self.terrain.height(at.x, at.y), |z, k| {
            let p = at + DVec2::from_angle(f64::from(k) * std::f64::consts::FRAC_PI_4) * reach;
            z.min(self.terrain.height(p.x, p.y))
        });
        let seed = (self.next() * 4e9) as u32;
        self.out.push(Solid {
            form,
            material,
            base: DVec3::new(at.x, at.y, z),
            axis: DVec2::from_angle(angle),
            colour,
            seed,
        });
        true
    }

    fn fill(&mut self, purpose: Use, density: f32) {
        let density = f64::from(density);
        let many = |n: f64| (n * density).round() as usize;
        let inner = BLOCK / 2.0 - ROAD_HALF - 5.0;
        match purpose {
            Use::Houses => {
                for k in 0..many(5.0) {
                    let at = DVec2::new(((k % 3) as f64 - 1.0) * 12.0, if k < 3 { -9.5 } else { 9.5 });
                    let at = at + DVec2::new(self.between(-1.2, 1.2), self.between(-1.5, 1.5));
                    self.house(at);
                }
                self.trees(many(9.0), inner, 1.0);
            }
            Use::Park => self.trees(many(13.0), inner, 1.25),
            Use::Field => {
                for _ in 0..many(6.0) {
                    let at = self.middle + DVec2::new(self.between(-inner, inner), self.between(-inner, inner));
                    let r = self.between(0.6, 0.9);
                    self.add(
                        Form::Ellipsoid { radius: r, half_height: r, centre: r },
                        Material::Straw,
                        at,
                        0.0,
                        [0.74, 0.63, 0.36],
                        r,
                    );
                }
                self.trees(many(2.0), inner, 1.0);
            }
            Use::CarPark => {
                for _ in 0..many(1.0) {
                    let (eave, tone) = (self.between(4.0, 7.0), self.between(0.45, 0.75) as f32);
                    let form = Form::Prism { half: DVec2::new(10.0, 5.0), eave, ridge: eave };
                    self.add(
                        form,
                        Material::House,
                        self.middle + DVec2::new(0.0, 10.0),
                        0.0,
                        [tone, tone * 0.96, tone * 0.9],
                        10.5,
                    );
                }
                for k in 0..many(22.0) {
                    if self.next() < 0.72 {
                        self.car(DVec2::new((k % 11) as f64 * 2.7 - 13.5, -12.0 + 7.5 * (k / 11) as f64));
                    }
                }
            }
            Use::Wood => self.trees(many(42.0), inner + 2.0, 1.1),
        }
    }

    fn house(&mut self, offset: DVec2) {
        let half = DVec2::new(self.between(4.2, 5.6), self.between(3.3, 4.4));
        let eave = self.between(2.8, 5.6);
        let ridge = eave + if self.next() < 0.2 { 0.0 } else { self.between(1.2, 2.8) };
        let turn = if self.next() < 0.5 { 0.0 } else { std::f64::consts::FRAC_PI_2 };
        let angle = turn + self.between(-0.2, 0.2);
        let palette =
            [[0.62, 0.29, 0.22], [0.38, 0.37, 0.39], [0.66, 0.58, 0.47], [0.47, 0.33, 0.27], [0.71, 0.70, 0.67]];
        let colour = palette[(self.next() * 4.99) as usize];
        self.add(
            Form::Prism { half, eave, ridge },
            Material::House,
            self.middle + offset,
            angle,
            colour,
            half.max_element(),
        );
    }

    fn car(&mut self, offset: DVec2) {
        let palette = [
            [0.75, 0.12, 0.10],
            [0.86, 0.86, 0.88],
            [0.12, 0.13, 0.15],
            [0.17, 0.27, 0.55],
            [0.55, 0.57, 0.58],
            [0.78, 0.66, 0.16],
        ];
        let colour = palette[(self.next() * 5.99) as usize];
        let (slip, turn) = (self.between(-0.4, 0.4), self.between(-0.06, 0.06));
        let at = self.middle + offset + DVec2::new(0.0, slip);
        let height = self.between(1.4, 1.7);
        self.add(
            Form::Prism { half: DVec2::new(2.15, 0.9), eave: height, ridge: height },
            Material::Car,
            at,
            std::f64::consts::FRAC_PI_2 + turn,
            colour,
            1.2,
        );
    }

    fn trees(&mut self, count: usize, inner: f64, size: f64) {
        for _ in 0..count {
            let at = self.middle + DVec2::new(self.between(-inner, inner), self.between(-inner, inner));
            let (shade, warm) = (self.between(0.75, 1.25) as f32, self.between(-0.04, 0.09) as f32);
            if self.next() < 0.3 {
                let (radius, top) = (size * self.between(1.2, 2.0), size * self.between(6.0, 10.5));
                let colour = [0.13 * shade, 0.27 * shade, 0.16 * shade];
                self.add(Form::Cone { radius, bottom: 0.4, top }, Material::Leaves, at, 0.0, colour, radius);
            } else {
                let (radius, half_height) = (size * self.between(1.3, 3.0), size * self.between(1.3, 2.4));
                let colour = [(0.22 + warm) * shade, (0.37 + 0.5 * warm) * shade, 0.13 * shade];
                let form = Form::Ellipsoid { radius, half_height, centre: half_height + self.between(0.6, 1.8) };
                self.add(form, Material::Leaves, at, 0.0, colour, radius);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_fixes_the_layout_and_another_seed_changes_it() {
        let terrain = Terrain::new(5, 150.0, 4.0);
        let print = |seed| format!("{:?}", populate(&terrain, seed, 1.0));
        assert_eq!(print(5), print(5));
        assert_ne!(print(5), print(6));
        assert!(populate(&terrain, 5, 1.0).len() > 200);
        assert!(populate(&terrain, 5, 0.0).is_empty());
    }
}
