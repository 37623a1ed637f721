//! What objects are made of: procedural textures, band-limited by the pixel's footprint.

use super::noise::{hash, octaves, unit, value};
use super::scene::SurfacePoint;

/// Linear RGB reflectance, 0..1.
pub type Rgb = [f32; 3];

/// A procedural material. Colours are linear RGB reflectances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Material {
    /// Painted plaster: faint mottling.
    Plaster(Rgb),
    /// Wallpaper: printed leaves, ground and leaf.
    Wallpaper(Rgb, Rgb),
    /// Planks of this width (m) along `a` (true) or `b`, with grain between two tones.
    Wood(Rgb, Rgb, f32, bool),
    /// A knotted carpet: ornament and border in three tones.
    Carpet(Rgb, Rgb, Rgb),
    /// Woven cloth.
    Fabric(Rgb),
    /// Printed cloth in two tones.
    Print(Rgb, Rgb),
    /// Square tiles of this side (m).
    Tiles(Rgb, Rgb, f32),
    /// A book, with bands and a title on its spine.
    Book(Rgb),
    /// A painting with a white mat.
    Picture,
    /// Printed paper.
    Paper,
    /// A computer's screen.
    Screen,
    /// Leaves.
    Leaves(Rgb),
    /// Glazed clay with rings.
    Ceramic(Rgb, Rgb),
    /// A window onto a landscape; shines.
    Window,
    /// A lamp; shines.
    Lamp,
}

fn mix(a: Rgb, b: Rgb, t: f32) -> Rgb {
    let t = t.clamp(0.0, 1.0);
    [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t]
}

fn scaled(a: Rgb, s: f32) -> Rgb {
    a.map(|v| v * s)
}

/// 0 below `-width`, 1 above `width`, smooth between: an edge as wide as a pixel.
fn step(x: f32, width: f32) -> f32 {
    let t = (0.5 + 0.5 * x / width).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A colour of even lightness from one random word.
fn hue(word: u32) -> Rgb {
    const PALETTE: [Rgb; 10] = [
        [0.45, 0.10, 0.07],
        [0.08, 0.16, 0.36],
        [0.10, 0.28, 0.15],
        [0.62, 0.45, 0.16],
        [0.60, 0.56, 0.48],
        [0.07, 0.07, 0.09],
        [0.30, 0.12, 0.26],
        [0.16, 0.38, 0.42],
        [0.66, 0.28, 0.12],
        [0.28, 0.20, 0.12],
    ];
    scaled(PALETTE[(hash(word, 17) % 10) as usize], 0.8 + 0.4 * unit(word, 18))
}

/// The palette's colour for one random word, for things that are not textured by [`Material::Picture`].
pub fn palette(word: u32) -> Rgb {
    hue(word)
}

impl Material {
    /// True if it shines by itself.
    pub fn shines(&self) -> bool {
        matches!(self, Material::Window | Material::Lamp)
    }

    /// Reflectance at a surface point; `footprint_m` is the width of a pixel there.
    pub fn reflectance(&self, at: &SurfacePoint, seed: u32, footprint_m: f32) -> Rgb {
        let seed = hash(seed, at.face as u32 + 1);
        let (a, b, w) = (at.a, at.b, footprint_m.max(5e-4));
        match *self {
            Material::Plaster(base) => scaled(base, 1.0 + 0.11 * octaves(a, b, 0.45, 5, w, seed)),
            Material::Wallpaper(base, leaf) => {
                // Leaning leaves in staggered columns, each printed a little differently.
                let column = (a / 0.12).floor();
                let shift = if column.rem_euclid(2.0) < 0.5 { 0.0 } else { 0.5 };
                let row = (b / 0.16 + shift).floor();
                let leaf_seed = hash(column as i32 as u32, hash(row as i32 as u32, seed));
                let (u, v) = (a / 0.12 - column - 0.5, b / 0.16 + shift - row - 0.5);
                let lean = 0.9 * (unit(leaf_seed, 1) - 0.5) + if shift > 0.0 { 0.6 } else { -0.6 };
                let (p, q) = (u * lean.cos() - v * lean.sin(), u * lean.sin() + v * lean.cos());
                let length = 0.34 + 0.10 * unit(leaf_seed, 2);
                let inside = (1.0 - (p / 0.17).powi(2) - (q / length).powi(2)) * 0.5;
                let vein = step(p.abs() - 0.012, 0.01 + w * 6.0);
                let shade = 1.0 + 0.10 * octaves(a, b, 0.3, 5, w, seed ^ 9);
                let fade = (0.12 / w - 1.0).clamp(0.0, 1.0);
                let printed =
                    step(inside, 0.06 + w * 6.0) * (0.5 + 0.5 * vein) * (0.6 + 0.4 * unit(leaf_seed, 3));
                scaled(mix(base, leaf, 0.3 + fade * (printed - 0.3)), shade)
            }
            Material::Wood(light, dark, plank_m, along_a) => {
                let (along, across) = if along_a { (a, b) } else { (b, a) };
                let row = (across / plank_m).floor();
                let offset = unit(row as i32 as u32, seed);
                let column = (along / 1.1 + offset).floor();
                let plank = hash(row as i32 as u32, hash(column as i32 as u32, seed));
                let grain = octaves(along * 0.09, across, 0.03, 4, w * 0.6, plank)
                    + 0.5 * octaves(along, across, 0.35, 2, w, plank ^ 3);
                let tone = 0.82 + 0.36 * unit(plank, 3);
                let colour = scaled(mix(light, dark, 0.45 + 0.55 * grain), tone);
                let in_row = across / plank_m - row;
                let in_column = along / 1.1 + offset - column;
                let gap = (in_row.min(1.0 - in_row) * plank_m).min(in_column.min(1.0 - in_column) * 1.1);
                scaled(colour, 0.55 + 0.45 * step(gap - 0.0025, 0.002 + w * 0.5))
            }
            Material::Carpet(ground, ornament, border) => {
                let (inner_a, inner_b) = (at.half.0 - a.abs(), at.half.1 - b.abs());
                let rim = inner_a.min(inner_b);
                // Mirrored in both axes, as woven carpets are, but worn differently everywhere.
                let figure =
                    value(a.abs() / 0.11, b.abs() / 0.11, seed) + 0.6 * value(a / 0.31, b / 0.31, seed ^ 1);
                let mut colour = mix(ground, ornament, step(figure, 0.12 + w * 6.0));
                colour = mix(border, colour, step(rim - 0.16, 0.003 + w * 0.5));
                let band = step((rim - 0.10).abs() - 0.02, 0.003 + w * 0.5);
                colour = mix(ornament, colour, band);
                scaled(colour, 1.0 + 0.25 * octaves(a, b, 0.05, 4, w, seed ^ 2))
            }
            Material::Fabric(base) => {
                let weave = octaves(a, b, 0.012, 2, w, seed);
                scaled(base, 1.0 + 0.15 * weave + 0.22 * octaves(a, b, 0.22, 4, w, seed ^ 7))
            }
            Material::Print(ground, figure) => {
                let shape = value(a / 0.06, b / 0.06, seed) + 0.5 * value(a / 0.025, b / 0.025, seed ^ 1);
                scaled(
                    mix(ground, figure, step(shape, 0.1 + w * 8.0)),
                    1.0 + 0.1 * octaves(a, b, 0.03, 3, w, seed),
                )
            }
            Material::Tiles(light, dark, side_m) => {
                let (ta, tb) = ((a / side_m).floor(), (b / side_m).floor());
                let tile = hash(ta as i32 as u32, hash(tb as i32 as u32, seed));
                let (ra, rb) = (a / side_m - ta, b / side_m - tb);
                let gap = ra.min(1.0 - ra).min(rb.min(1.0 - rb)) * side_m;
                let vein = octaves(a, b, 0.3, 5, w, tile);
                let colour = scaled(mix(light, dark, unit(tile, 1) * 0.6 + 0.3 * vein), 1.0 + 0.2 * vein);
                scaled(colour, 0.6 + 0.4 * step(gap - 0.003, 0.002 + w * 0.5))
            }
            Material::Book(base) => {
                let worn = scaled(base, 1.0 + 0.2 * octaves(a, b, 0.05, 3, w, seed));
                let height = b + at.half.1;
                let band_at = at.half.1 * (0.3 + 1.5 * unit(seed, 1));
                let band = 1.0 - step((height - band_at).abs() - 0.012, 0.002 + w * 0.5);
                let label = 1.0
                    - step(
                        (b - at.half.1 * (0.4 * unit(seed, 2) - 0.1)).abs() - at.half.1 * 0.3,
                        0.002 + w * 0.5,
                    );
                let letters = step(value(a / 0.008, b / 0.006, seed ^ 4) - 0.1, 0.3 + w * 40.0);
                let gold: Rgb = if unit(seed, 5) > 0.5 { [0.62, 0.5, 0.22] } else { [0.75, 0.73, 0.66] };
                mix(mix(worn, gold, band * 0.8), gold, label * letters * 0.6)
            }
            Material::Picture => {
                let mat = at.half.0.min(at.half.1) * 0.14;
                let rim = (at.half.0 - a.abs()).min(at.half.1 - b.abs());
                let horizon = at.half.1 * (0.5 * unit(seed, 9) - 0.2) + 0.12 * value(a / 0.17, 0.5, seed);
                let cloud = octaves(a, b, 0.22, 5, w, seed ^ 1);
                let sky = mix(hue(seed ^ 21), [0.75, 0.74, 0.68], 0.45 + 0.5 * cloud);
                let field = octaves(a * 0.6, b * 1.6, 0.12, 5, w, seed ^ 2);
                let land = mix(hue(seed ^ 22), hue(seed ^ 23), 0.5 + 0.9 * field);
                let mut colour = mix(land, sky, step(b - horizon, 0.01 + w));
                // A few painted shapes.
                for i in 0..5u32 {
                    let s = hash(seed, 40 + i);
                    let (ca, cb) =
                        (at.half.0 * (1.4 * unit(s, 1) - 0.7), at.half.1 * (1.4 * unit(s, 2) - 0.7));
                    let (ra, rb) = (0.04 + 0.09 * unit(s, 3), 0.04 + 0.12 * unit(s, 4));
                    let inside = if i % 2 == 0 {
                        1.0 - ((a - ca) / ra).hypot((b - cb) / rb)
                    } else {
                        (1.0 - ((a - ca) / ra).abs()).min(1.0 - ((b - cb) / rb).abs())
                    };
                    let shaded = scaled(hue(s), 0.8 + 0.5 * octaves(a, b, 0.06, 3, w, s));
                    colour = mix(colour, shaded, step(inside * ra, 0.003 + w * 0.5));
                }
                mix([0.72, 0.70, 0.65], colour, step(rim - mat, 0.002 + w * 0.5))
            }
            Material::Paper => {
                let line = (b / 0.012).floor();
                let word = value(a / 0.012, line * 3.7, seed) + 0.1;
                let in_line = (b / 0.012 - line - 0.5).abs();
                let ink = step(word, 0.2 + w * 20.0) * (1.0 - step(in_line - 0.25, 0.1 + w * 40.0));
                let rim = (at.half.0 - a.abs()).min(at.half.1 - b.abs());
                mix([0.8, 0.79, 0.75], [0.12, 0.12, 0.16], ink * step(rim - 0.018, 0.003) * 0.8)
            }
            Material::Screen => {
                let mut colour =
                    mix([0.03, 0.05, 0.10], [0.05, 0.14, 0.18], 0.5 + 0.5 * octaves(a, b, 0.2, 3, w, seed));
                for i in 0..4u32 {
                    let s = hash(seed, i);
                    let (ca, cb) = (at.half.0 * (unit(s, 1) - 0.5), at.half.1 * (unit(s, 2) - 0.5));
                    let inside = (0.09 - (a - ca).abs()).min(0.06 - (b - cb).abs());
                    let text = step(value(a / 0.01, (b / 0.012).floor() * 2.3, s), 0.3 + w * 20.0);
                    let pane = mix([0.55, 0.56, 0.58], scaled(hue(s), 0.6), text * 0.8);
                    colour = mix(colour, pane, step(inside, 0.002 + w * 0.5));
                }
                colour
            }
            Material::Leaves(base) => {
                let leaf = octaves(a, b, 0.05, 4, w, seed);
                mix(scaled(base, 0.45), scaled(base, 1.6), 0.5 + 0.9 * leaf)
            }
            Material::Ceramic(base, ring) => {
                let wave = ((b + 0.01 * value(a / 0.05, 0.5, seed)) / 0.045 + unit(seed, 1) * 6.0).sin();
                let glaze = 1.0 + 0.15 * octaves(a, b, 0.08, 4, w, seed);
                scaled(mix(base, ring, step(wave - 0.3, 0.15 + w * 20.0)), glaze)
            }
            Material::Window => {
                let horizon =
                    -0.15 + 0.12 * value(a / 0.25, 0.5, seed) + 0.04 * value(a / 0.06, 0.5, seed ^ 1);
                let sky = mix(
                    [0.55, 0.68, 0.9],
                    [0.95, 0.95, 0.95],
                    0.4 + 0.8 * octaves(a, b * 2.0, 0.5, 4, w, seed),
                );
                let trees = mix(
                    [0.10, 0.18, 0.06],
                    [0.32, 0.42, 0.16],
                    0.5 + 0.9 * octaves(a, b, 0.1, 4, w, seed ^ 2),
                );
                mix(trees, sky, step(b - horizon, 0.01 + w))
            }
            Material::Lamp => [1.0, 0.95, 0.85],
        }
    }
}
