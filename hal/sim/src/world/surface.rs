//! Colours of every surface, evaluated at a point of the world: patterns large enough to recognise a place by,
//! and fine marks (stones, weeds, cracks, leaves) for features and stereo to bite on down to the pixel.

use glam::{DVec2, DVec3};

use super::layout::{BLOCK, ROAD_HALF, Use, block_use, road_line};
use super::noise::{fade, floor, hash, octaves, unit, unit2, wave};
use super::solids::{Form, Material, Solid};

type Colour = [f32; 3];

/// Fine structure shared by all grounds: wavelength (m), amplitude.
const GRAIN: [(f32, f32); 4] = [(2.7, 0.10), (0.9, 0.09), (0.37, 0.09), (0.16, 0.08)];

fn scale(c: Colour, f: f32) -> Colour {
    c.map(|v| v * f)
}

fn mix(a: Colour, b: Colour, t: f32) -> Colour {
    let t = t.clamp(0.0, 1.0);
    [0, 1, 2].map(|k| a[k] + (b[k] - a[k]) * t)
}

/// Nearest integer.
fn nearest(x: f64) -> f64 {
    f64::from(floor(x + 0.5))
}

/// 1 inside a stripe of half width `half` around 0, with an edge as wide as the footprint.
fn stripe(distance: f64, half: f64, footprint: f32) -> f32 {
    let f = f64::from(footprint).max(1e-4);
    // A stripe thinner than the footprint keeps its share of the light.
    ((half - distance.abs()) / f + 0.5).clamp(0.0, (2.0 * half / f).min(1.0)) as f32
}

/// Discs strewn over the plane, one per cell of `cell` metres at most: distinct corners and blobs.
fn strew(p: DVec2, cell: f64, share: f32, size: (f32, f32), footprint: f32, seed: u32) -> Option<(f32, u32)> {
    if fade(2.0 * size.1, footprint) == 0.0 {
        return None;
    }
    let (i, j) = (floor(p.x / cell), floor(p.y / cell));
    let h = hash(i, j, seed);
    if unit(h) > share {
        return None;
    }
    let kind = hash(h as i32, 11, seed);
    let radius = f64::from(size.0 + (size.1 - size.0) * unit(kind));
    let room = cell - 2.0 * radius;
    let middle = DVec2::new(
        f64::from(i) * cell + radius + room * f64::from(unit2(h)),
        f64::from(j) * cell + radius + room * f64::from(unit2(kind)),
    );
    let cover = stripe((p - middle).length(), radius, footprint);
    (cover > 0.0).then_some((cover, kind))
}

/// Albedo of the ground at a place; `footprint` is the distance between samples there, metres.
pub fn ground(x: f64, y: f64, footprint: f32, seed: u32) -> Colour {
    let p = DVec2::new(x, y);
    // Which roads enclose this place: the jitter is far below half a block, so one correction step suffices.
    let index = |a: f64, along: f64, salt: u32| {
        let line = |k| road_line(k, along, salt);
        let mut k = floor(a * (1.0 / BLOCK));
        let (mut low, mut high) = (line(k), line(k + 1));
        if a < low {
            (k, high) = (k - 1, low);
            low = line(k);
        } else if a >= high {
            (k, low) = (k + 1, high);
            high = line(k + 1);
        }
        let (low, high) = (a - low, high - a);
        (k, if low < high { low } else { -high })
    };
    let (i, from_v) = index(x, y, seed ^ 0x11);
    let (j, from_h) = index(y, x, seed ^ 0x22);
    let grain = octaves(x, y, footprint, &GRAIN, seed);
    let (near, along) = if from_v.abs() < from_h.abs() { (from_v, y) } else { (from_h, x) };
    if near.abs() < ROAD_HALF {
        let crossing = from_v.abs().max(from_h.abs()) < ROAD_HALF;
        return road(p, near, along, crossing, grain, footprint, seed);
    }
    let tone = unit(hash(i, j, seed ^ 0x70));
    match block_use(i, j, seed) {
        Use::Field => field(p, hash(i, j, seed), tone, grain, footprint, seed),
        Use::CarPark => {
            car_park(p, DVec2::new((f64::from(i) + 0.5) * BLOCK, (f64::from(j) + 0.5) * BLOCK), grain, footprint, seed)
        }
        Use::Park => park(
            p,
            DVec2::new((f64::from(i) + 0.5) * BLOCK, (f64::from(j) + 0.5) * BLOCK),
            tone,
            grain,
            footprint,
            seed,
        ),
        Use::Wood => strewn(mix([0.24, 0.25, 0.13], [0.33, 0.24, 0.15], 0.5 + 2.2 * grain), p, 0.55, footprint, seed),
        Use::Houses => lawn(p, tone, grain, footprint, seed),
    }
}

/// Adds stones, leaves and weeds of both contrasts.
fn strewn(base: Colour, p: DVec2, share: f32, footprint: f32, seed: u32) -> Colour {
    let mut c = base;
    for (cell, size, salt) in [(2.3, (0.15, 0.55), 0x3A), (0.8, (0.07, 0.22), 0x3B)] {
        if let Some((cover, kind)) = strew(p, cell, share, size, footprint, seed ^ salt) {
            let light = if kind & 1 == 0 { 1.35 + 0.5 * unit2(kind) } else { 0.45 + 0.3 * unit2(kind) };
            let warm = (unit(kind.wrapping_mul(77)) - 0.5) * 0.16;
            let mark = scale(base, light);
            c = mix(c, [mark[0] + warm, mark[1], mark[2] - warm], cover);
        }
    }
    c
}

fn lawn(p: DVec2, tone: f32, grain: f32, footprint: f32, seed: u32) -> Colour {
    let green = mix([0.27, 0.40, 0.17], [0.40, 0.46, 0.22], tone);
    let bare = octaves(p.x, p.y, footprint, &[(9.0, 0.7), (3.1, 0.4)], seed ^ 0x1A);
    let c = mix(green, [0.52, 0.45, 0.33], 4.0 * (bare - 0.35));
    strewn(scale(c, 1.0 + 1.6 * grain), p, 0.5, footprint, seed)
}

fn field(p: DVec2, h: u32, tone: f32, grain: f32, footprint: f32, seed: u32) -> Colour {
    let direction = DVec2::from_angle(std::f64::consts::PI * f64::from(unit(h)));
    let wave = f64::from(octaves(p.x, p.y, footprint, &[(7.0, 0.25)], seed ^ 0x2F));
    let across = p.dot(direction.perp()) + wave;
    let period = 1.1 + 0.6 * f64::from(unit2(h));
    let row = nearest(across / period);
    // Plants missing along a row: no two stretches of it are alike.
    let gap = octaves(p.dot(direction), row * 5.3, footprint, &[(1.7, 0.8), (0.6, 0.5)], seed ^ h);
    let plant = stripe(across - row * period, 0.3 * period * f64::from(0.8 + 0.5 * gap).clamp(0.1, 1.6), footprint);
    let soil = mix([0.45, 0.34, 0.24], [0.55, 0.46, 0.34], tone);
    let leaf = mix([0.25, 0.40, 0.14], [0.60, 0.56, 0.24], unit(h.wrapping_mul(31)));
    strewn(scale(mix(soil, leaf, plant), 1.0 + 1.7 * grain), p, 0.4, footprint, seed)
}

fn park(p: DVec2, middle: DVec2, tone: f32, grain: f32, footprint: f32, seed: u32) -> Colour {
    let q = p - middle - DVec2::new(4.0, 3.0);
    let half = DVec2::new(7.2, 4.0);
    if q.x.abs() < half.x && q.y.abs() < half.y {
        // A ball court: coloured, worn, with lines.
        let mut c =
            mix([0.58, 0.25, 0.20], [0.20, 0.33, 0.50], if q.x.abs() < 4.9 && q.y.abs() < 3.0 { 1.0 } else { 0.0 });
        c = scale(c, 1.0 + 0.9 * grain);
        let edge = stripe(q.x.abs() - 6.4, 0.06, footprint)
            .max(stripe(q.y.abs() - 3.4, 0.06, footprint))
            .max(stripe(q.x, 0.06, footprint));
        let inside = if q.x.abs() < 6.5 && q.y.abs() < 3.5 { 1.0 } else { 0.0 };
        let ring = stripe(q.length() - 1.4, 0.06, footprint);
        c = mix(c, [0.92, 0.91, 0.88], (edge * inside).max(ring));
        return strewn(c, p, 0.22, footprint, seed);
    }
    // A gravel path winding across.
    let path = p.y - middle.y + 8.0 - 3.0 * wave(p.x / 57.0 + f64::from(tone));
    if path.abs() < 1.1 {
        return strewn(scale([0.66, 0.60, 0.50], 1.0 + 1.5 * grain), p, 0.65, footprint, seed);
    }
    lawn(p, 1.0 - tone, grain, footprint, seed)
}

fn asphalt(p: DVec2, grain: f32, footprint: f32, seed: u32) -> Colour {
    let patch = octaves(p.x, p.y, footprint, &[(5.3, 0.5), (1.9, 0.35)], seed ^ 0x4C);
    let crack = octaves(p.x, p.y, footprint, &[(2.9, 0.8), (0.8, 0.3)], seed ^ 0x4D);
    let base = scale([0.36, 0.36, 0.37], 1.0 + 0.9 * grain + if patch > 0.28 { -0.28 } else { 0.05 });
    strewn(mix(base, [0.14, 0.14, 0.15], stripe(f64::from(crack), 0.025, footprint.min(0.1))), p, 0.28, footprint, seed)
}

fn road(p: DVec2, near: f64, along: f64, crossing: bool, grain: f32, footprint: f32, seed: u32) -> Colour {
    let off = near.abs();
    if off > 3.0 && !crossing {
        // Pavement slabs of uneven tone.
        let slab = 0.9 + 0.25 * unit(hash(floor(along / 1.2), floor(near / 0.8), seed ^ 0x5E));
        let joint =
            stripe(along - 1.2 * nearest(along / 1.2), 0.035, footprint).max(stripe(off - 3.8, 0.03, footprint));
        let c = scale([0.60, 0.58, 0.55], slab * (1.0 + 0.8 * grain));
        return mix(strewn(c, p, 0.15, footprint, seed), [0.28, 0.28, 0.27], 0.8 * joint);
    }
    let c = asphalt(p, grain, footprint, seed);
    if crossing {
        return c;
    }
    let dash = if along / 3.0 - f64::from(floor(along / 3.0)) < 0.55 { 1.0 } else { 0.0 };
    let worn = 0.75 + 2.0 * grain;
    let paint = (stripe(off, 0.09, footprint) * dash).max(stripe(off - 2.75, 0.07, footprint));
    mix(c, [0.88, 0.87, 0.82], paint * worn)
}

fn car_park(p: DVec2, middle: DVec2, grain: f32, footprint: f32, seed: u32) -> Colour {
    let q = p - middle;
    let c = asphalt(p, grain, footprint, seed ^ 0x6);
    if q.y < 0.0 && q.y > -15.0 && q.x.abs() < 16.3 {
        let bay = stripe((q.x - 2.7 * nearest((q.x - 1.35) / 2.7)) - 1.35, 0.06, footprint).max(stripe(
            (q.x - 2.7 * nearest((q.x - 1.35) / 2.7)) + 1.35,
            0.06,
            footprint,
        ));
        let lines = if (q.y + 8.2).abs() < 0.9 || q.y > -1.9 { 0.0 } else { bay };
        return mix(c, [0.86, 0.84, 0.72], lines * (0.8 + 1.8 * grain));
    }
    c
}

/// Albedo of a solid at a point of its surface.
pub fn solid(s: &Solid, p: DVec3, normal: DVec3, footprint: f32) -> Colour {
    match s.material {
        Material::Leaves => {
            // Slanted coordinates: the pattern is not stretched on steep sides.
            let (u, v) = (p.x + 0.8 * p.z, p.y - 0.6 * p.z);
            let clumps = octaves(u, v, footprint, &[(1.1, 0.30), (0.45, 0.32), (0.2, 0.25)], s.seed);
            let light = strew(DVec2::new(u, v), 0.5, 0.45, (0.06, 0.17), footprint, s.seed)
                .map_or(0.0, |(c, k)| c * (unit(k) - 0.35));
            scale(s.colour, (1.0 + clumps + 1.1 * light).max(0.15))
        }
        Material::Straw => {
            scale(s.colour, 1.0 + octaves(p.x + 2.0 * p.z, p.y, footprint, &[(0.5, 0.3), (0.2, 0.3)], s.seed))
        }
        Material::Car => car(s, s.local(p), normal),
        Material::House if normal.z > 0.3 => roof(s, s.local(p), footprint),
        Material::House => wall(s, p, normal, footprint),
    }
}

fn car(s: &Solid, q: DVec3, normal: DVec3) -> Colour {
    let glass =
        if normal.z > 0.5 { (q.x > 0.45 && q.x < 1.0) || (q.x < -0.9 && q.x > -1.4) } else { q.z > 0.85 && q.z < 1.3 };
    if glass { [0.10, 0.12, 0.14] } else { scale(s.colour, if normal.z > 0.5 && q.x > 1.0 { 0.9 } else { 1.0 }) }
}

fn roof(s: &Solid, q: DVec3, footprint: f32) -> Colour {
    let p = DVec2::new(q.x, q.y);
    let grain = octaves(q.x, q.y, footprint, &[(2.1, 0.14), (0.7, 0.12), (0.28, 0.12)], s.seed);
    let flat = matches!(s.form, Form::Prism { eave, ridge, .. } if ridge <= eave);
    let mut c = scale(s.colour, 1.0 + grain);
    if flat {
        // Roofing felt in strips, with vents and skylights.
        let strip = unit(hash(floor(q.x / 1.6), floor(q.y / 4.0), s.seed));
        c = scale(c, 0.85 + 0.3 * strip);
    } else {
        // Courses of tiles, every tile of its own tone.
        let course = floor(q.y / 0.42);
        let tile = unit(hash(course, floor(q.x / 0.5 + 0.5 * f64::from(course)), s.seed));
        c = scale(c, 1.0 + (0.5 * tile - 0.25) * fade(0.45, footprint));
        c = mix(
            c,
            scale(s.colour, 0.45),
            0.7 * stripe(q.y - 0.42 * nearest(q.y / 0.42), 0.04, footprint) * fade(0.42, footprint),
        );
        c = mix(c, scale(s.colour, 1.4), stripe(q.y, 0.12, footprint));
    }
    if let Some((cover, kind)) = strew(p, 2.6, 0.4, (0.25, 0.5), footprint, s.seed ^ 0x7) {
        c = mix(c, if kind & 1 == 0 { [0.18, 0.21, 0.26] } else { [0.80, 0.79, 0.76] }, cover);
    }
    c
}

fn wall(s: &Solid, p: DVec3, normal: DVec3, footprint: f32) -> Colour {
    let u = p.x * -normal.y + p.y * normal.x;
    let z = p.z - s.base.z;
    let grain = octaves(u, z, footprint, &[(1.4, 0.08), (0.4, 0.08)], s.seed);
    let plaster = 0.62 + 0.25 * unit(s.seed);
    let c = [plaster * (1.0 + grain), plaster * 0.96 * (1.0 + grain), plaster * 0.88 * (1.0 + grain)];
    let (du, dz) = (u - 2.4 * nearest(u / 2.4), z - 2.7 * f64::from(floor(z / 2.7)) - 1.5);
    if du.abs() < 0.62 && dz.abs() < 0.72 {
        if du.abs() < 0.5 && dz.abs() < 0.6 { [0.13, 0.16, 0.21] } else { [0.9, 0.9, 0.88] }
    } else {
        c
    }
}
