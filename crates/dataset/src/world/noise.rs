//! Hash noise: the same seed gives the same pattern everywhere, with no state and no tables.

/// Mixes two words into one (the finaliser of MurmurHash3 over a Weyl step).
#[inline]
pub fn hash(a: u32, b: u32) -> u32 {
    let mut h = a.wrapping_mul(0x9E37_79B1) ^ b.wrapping_mul(0x85EB_CA77).rotate_left(13);
    h ^= h >> 16;
    h = h.wrapping_mul(0x7FEB_352D);
    h ^= h >> 15;
    h = h.wrapping_mul(0x846C_A68B);
    h ^ (h >> 16)
}

/// A uniform value in 0..1.
#[inline]
pub fn unit(a: u32, b: u32) -> f32 {
    (hash(a, b) >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// A standard normal value (Box and Muller 1958).
#[inline]
pub fn normal(a: u32, b: u32) -> f32 {
    let (u, v) = (unit(a, b).max(1e-7), unit(a ^ 0x5bd1_e995, b.wrapping_add(0x0123_4567)));
    (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
}

/// Value noise in -1..1 with one lattice cell per unit.
#[inline]
pub fn value(x: f32, y: f32, seed: u32) -> f32 {
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = (x - x0, y - y0);
    let (ix, iy) = (x0 as i32 as u32, y0 as i32 as u32);
    let corner = |dx: u32, dy: u32| unit(ix.wrapping_add(dx), hash(iy.wrapping_add(dy), seed));
    let (sx, sy) = (fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy));
    let top = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * sx;
    let bottom = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * sx;
    2.0 * (top + (bottom - top) * sy) - 1.0
}

/// Octaves of [`value`] noise, in about -1..1. The longest wavelength is `wavelength_m`; octaves finer
/// than the pixel's `footprint_m` fade out, so that distant texture blurs instead of flickering.
#[inline]
pub fn octaves(x_m: f32, y_m: f32, wavelength_m: f32, count: u32, footprint_m: f32, seed: u32) -> f32 {
    let (mut sum, mut amplitude, mut wavelength) = (0.0, 0.6, wavelength_m);
    for octave in 0..count {
        let visible = (wavelength / footprint_m - 1.0).clamp(0.0, 1.0);
        if visible <= 0.0 {
            break;
        }
        sum +=
            visible * amplitude * value(x_m / wavelength, y_m / wavelength, seed.wrapping_add(octave * 7919));
        amplitude *= 0.72;
        wavelength *= 0.45;
    }
    sum
}
