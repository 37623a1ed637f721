//! Packing to 23 bytes a surfel, for disk and network.
//!
//! ```text
//! header, 40 bytes:  "SFL1"  u32 count  u32 flags (0)  f32 box_min[3]  f32 box_max[3]  u32 0
//! surfel, 23 bytes:  u24 centre[3]  u16 rotation[3]  u16 scale[2]  u8 opacity  u8 color[3]
//! ```
//! All numbers are little-endian.
//!
//! * Centre: 0 to 2^24 - 1 across the cloud's own box.
//! * Rotation: the three smaller components of the unit quaternion `w x y z`, in that order, in 15 bits over
//!   -1/sqrt(2) to 1/sqrt(2); the upper bits of the first two numbers name the largest component, which is
//!   positive.
//! * Scales: 0 to 65535 over the logarithm from 1 micrometre to 100 metres.
//! * Opacity and colour: 0 to 255 over 0 to 1; values outside are clamped.
//!
//! Errors of what comes back, at most:
//!
//! | what | error |
//! |---|---|
//! | centre | half of 2^-24 of the box on each axis, and the rounding of `f32`: under 2 micrometres within 16 m |
//! | rotation | 1.6e-4 rad |
//! | scales | 1.5e-4 relative, between 1 micrometre and 100 metres |
//! | opacity, colour | 1/510 |
//!
//! A surfel with a value that is not finite keeps its place in the order and becomes invisible.

use crate::{Surfel, SurfelCloud};

/// Bytes before the first surfel.
pub const HEADER_BYTES: usize = 40;
/// Bytes of one surfel.
pub const SURFEL_BYTES: usize = 23;

const MAGIC: &[u8; 4] = b"SFL1";
const CENTER_STEPS: f64 = ((1 << 24) - 1) as f64;
/// Half of 2^15 - 1 steps, and an even number of them, so that 0 is one of the codes.
const ROTATION_HALF: f64 = 16383.0;
const SCALE_MIN_M: f64 = 1e-6;
const SCALE_MAX_M: f64 = 1e2;

/// Why bytes are no packed surfels.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UnpackError {
    /// Too short, another format, or of a later version.
    #[error("header: no packed surfels of version 1")]
    Header,
    /// More than the reader takes.
    #[error("count: {count} surfels, at most {max} are taken")]
    TooMany {
        /// What the header says.
        count: usize,
        /// What is taken.
        max: usize,
    },
    /// Cut off, or something follows.
    #[error("length: {found} bytes for {count} surfels, {needed} are needed")]
    Length {
        /// Bytes that came.
        found: usize,
        /// What the header says.
        count: usize,
        /// Bytes of so many surfels.
        needed: usize,
    },
    /// A box that is none.
    #[error("box: axis {axis} runs from {min} to {max}")]
    Box {
        /// 0 to 2 for x to z.
        axis: usize,
        /// As text: it may be no number.
        min: String,
        /// As text: it may be no number.
        max: String,
    },
}

/// Bytes of so many surfels, header included.
pub const fn packed_bytes(count: usize) -> usize {
    count.saturating_mul(SURFEL_BYTES).saturating_add(HEADER_BYTES)
}

/// Packs surfels in their order. More than `u32::MAX` of them would be cut there.
pub fn pack(surfels: &SurfelCloud) -> Vec<u8> {
    let count = surfels.len().min(u32::MAX as usize);
    let (box_min, box_max) = bounds(surfels);
    let mut out = Vec::with_capacity(packed_bytes(count));
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&(count as u32).to_le_bytes());
    out.extend_from_slice(&[0; 4]);
    for value in box_min.iter().chain(&box_max) {
        out.extend_from_slice(&value.to_le_bytes());
    }
    out.extend_from_slice(&[0; 4]);
    for surfel in surfels.iter().take(count) {
        pack_one(&surfel, &box_min, &box_max, &mut out);
    }
    out
}

/// Unpacks at most `max_surfels`. Any bytes are answered, none make it panic, and nothing is allocated
/// before the count and the length agree.
pub fn unpack(bytes: &[u8], max_surfels: usize) -> Result<SurfelCloud, UnpackError> {
    let Header { box_min, box_max, packed, .. } = Header::read(bytes, max_surfels)?;
    let packed = packed.chunks_exact(SURFEL_BYTES);
    Ok(packed.map(|bytes| unpack_one(bytes, &box_min, &box_max)).collect())
}

/// How many surfels [`unpack`] would give, without unpacking them.
pub fn count(bytes: &[u8], max_surfels: usize) -> Result<usize, UnpackError> {
    Ok(Header::read(bytes, max_surfels)?.count)
}

struct Header<'a> {
    count: usize,
    box_min: [f32; 3],
    box_max: [f32; 3],
    /// What follows: `count` surfels.
    packed: &'a [u8],
}

impl<'a> Header<'a> {
    fn read(bytes: &'a [u8], max_surfels: usize) -> Result<Self, UnpackError> {
        let header = bytes.first_chunk::<HEADER_BYTES>().ok_or(UnpackError::Header)?;
        let word = |i: usize| [header[4 * i], header[4 * i + 1], header[4 * i + 2], header[4 * i + 3]];
        if word(0) != *MAGIC || word(2) != [0; 4] || word(9) != [0; 4] {
            return Err(UnpackError::Header);
        }
        let count = u32::from_le_bytes(word(1)) as usize;
        if count > max_surfels {
            return Err(UnpackError::TooMany { count, max: max_surfels });
        }
        let needed = packed_bytes(count);
        if bytes.len() != needed {
            return Err(UnpackError::Length { found: bytes.len(), count, needed });
        }
        let box_min: [f32; 3] = std::array::from_fn(|axis| f32::from_le_bytes(word(3 + axis)));
        let box_max: [f32; 3] = std::array::from_fn(|axis| f32::from_le_bytes(word(6 + axis)));
        for axis in 0..3 {
            let (min, max) = (box_min[axis], box_max[axis]);
            if !(min.is_finite() && max.is_finite() && min <= max) {
                return Err(UnpackError::Box { axis, min: min.to_string(), max: max.to_string() });
            }
        }
        Ok(Header { count, box_min, box_max, packed: &bytes[HEADER_BYTES..] })
    }
}

/// The box of all finite centres.
fn bounds(surfels: &SurfelCloud) -> ([f32; 3], [f32; 3]) {
    let mut finite = surfels.center_m.iter().filter(|c| c.iter().all(|v| v.is_finite()));
    let Some(first) = finite.next() else { return ([0.0; 3], [0.0; 3]) };
    finite.fold((*first, *first), |(min, max), center| {
        (std::array::from_fn(|i| min[i].min(center[i])), std::array::from_fn(|i| max[i].max(center[i])))
    })
}

fn pack_one(surfel: &Surfel, box_min: &[f32; 3], box_max: &[f32; 3], out: &mut Vec<u8>) {
    let Surfel { center_m, rotation_wxyz, scale_m, opacity, color } = surfel;
    for axis in 0..3 {
        let (min, max) = (f64::from(box_min[axis]), f64::from(box_max[axis]));
        let share = if max > min { (f64::from(center_m[axis]) - min) / (max - min) } else { 0.0 };
        let code = (share.clamp(0.0, 1.0) * CENTER_STEPS).round() as u32;
        out.extend_from_slice(&code.to_le_bytes()[..3]);
    }
    for code in rotation_codes(rotation_wxyz) {
        out.extend_from_slice(&code.to_le_bytes());
    }
    for scale in scale_m {
        let scale = f64::from(*scale).clamp(SCALE_MIN_M, SCALE_MAX_M);
        let share = (scale / SCALE_MIN_M).ln() / (SCALE_MAX_M / SCALE_MIN_M).ln();
        out.extend_from_slice(&((share * 65535.0).round() as u16).to_le_bytes());
    }
    out.push(if surfel.is_finite() { byte(*opacity) } else { 0 });
    out.extend(color.map(byte));
}

fn unpack_one(bytes: &[u8], box_min: &[f32; 3], box_max: &[f32; 3]) -> Surfel {
    let short = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
    let center_m = std::array::from_fn(|axis| {
        let at = 3 * axis;
        let code = u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], 0]);
        let (min, max) = (f64::from(box_min[axis]), f64::from(box_max[axis]));
        (min + (max - min) * (f64::from(code) / CENTER_STEPS)) as f32
    });
    let scale = |code: u16| {
        let share = f64::from(code) / 65535.0;
        (SCALE_MIN_M * (share * (SCALE_MAX_M / SCALE_MIN_M).ln()).exp()) as f32
    };
    let unit = |at: usize| f32::from(bytes[at]) / 255.0;
    Surfel {
        center_m,
        rotation_wxyz: rotation([short(9), short(11), short(13)]),
        scale_m: [scale(short(15)), scale(short(17))],
        opacity: unit(19),
        color: [unit(20), unit(21), unit(22)],
    }
}

/// NaN becomes 0.
fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn rotation_codes(rotation_wxyz: &[f32; 4]) -> [u16; 3] {
    let q = rotation_wxyz.map(f64::from);
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    // What is no rotation becomes identity.
    let q = if norm.is_finite() && norm > 1e-12 { q.map(|v| v / norm) } else { [1.0, 0.0, 0.0, 0.0] };
    let largest = (0..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let sign = q[largest].signum();
    let mut codes = [0; 3];
    for (code, i) in codes.iter_mut().zip((0..4).filter(|i| *i != largest)) {
        let share = (q[i] * sign * std::f64::consts::SQRT_2).clamp(-1.0, 1.0);
        *code = (share * ROTATION_HALF + ROTATION_HALF).round() as u16;
    }
    codes[0] |= ((largest & 1) << 15) as u16;
    codes[1] |= ((largest >> 1) << 15) as u16;
    codes
}

fn rotation(codes: [u16; 3]) -> [f32; 4] {
    let largest = usize::from(codes[0] >> 15) | usize::from(codes[1] >> 15) << 1;
    let small = codes
        .map(|code| (f64::from(code & 0x7fff) - ROTATION_HALF) / (ROTATION_HALF * std::f64::consts::SQRT_2));
    let rest = (1.0 - small.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    let mut next = small.iter();
    let q: [f64; 4] = std::array::from_fn(|i| {
        if i == largest { rest } else { *next.next().expect("three are not the largest") }
    });
    // Codes that no packer writes can be longer than 1: they too come back as a rotation.
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    q.map(|v| (v / norm) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Quaternion, UnitQuaternion};

    /// A fixed sequence of numbers in 0..1, so that the tests are the same every time.
    fn numbers() -> impl FnMut() -> f32 {
        let mut state = 0x2545_f491_4f6c_dd1d_u64;
        move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1 << 24) as f32
        }
    }

    fn cloud(count: usize) -> SurfelCloud {
        let mut next = numbers();
        let surfel = |_| {
            let q = Quaternion::new(next() - 0.5, next() - 0.5, next() - 0.5, next() - 0.5);
            let q = UnitQuaternion::from_quaternion(q);
            Surfel {
                center_m: [next() * 16.0 - 8.0, next() * 4.0, next() * 16.0 - 3.0],
                rotation_wxyz: [q.w, q.i, q.j, q.k],
                scale_m: [10f32.powf(next() * 7.9 - 5.9), 0.01 * next() + 1e-4],
                opacity: next(),
                color: [next(), next(), next()],
            }
        };
        (0..count).map(surfel).collect()
    }

    /// By the distance between the quaternions, which keeps its digits where the cosine loses them.
    fn angle_rad(a: [f32; 4], b: [f32; 4]) -> f64 {
        let distance = |sign: f64| {
            a.iter().zip(b).map(|(x, y)| (f64::from(*x) - sign * f64::from(y)).powi(2)).sum::<f64>().sqrt()
        };
        4.0 * (distance(1.0).min(distance(-1.0)) / 2.0).asin()
    }

    #[test]
    fn what_comes_back_is_within_the_stated_errors_and_24_bytes() {
        let before = cloud(5000);
        let bytes = pack(&before);
        assert!(bytes.len() <= 24 * before.len());
        assert_eq!(count(&bytes, before.len()), Ok(before.len()));
        let after = unpack(&bytes, before.len()).unwrap();
        assert_eq!(after.len(), before.len());
        for (a, b) in before.iter().zip(after.iter()) {
            for axis in 0..3 {
                assert!((a.center_m[axis] - b.center_m[axis]).abs() < 2e-6, "{a:?} {b:?}");
                assert!((a.color[axis] - b.color[axis]).abs() < 1.0 / 509.9);
            }
            for (x, y) in a.scale_m.iter().zip(b.scale_m) {
                assert!((x / y - 1.0).abs() < 1.5e-4, "{x} {y}");
            }
            assert!((a.opacity - b.opacity).abs() < 1.0 / 509.9);
            assert!(angle_rad(a.rotation_wxyz, b.rotation_wxyz) < 1.6e-4, "{a:?} {b:?}");
        }
    }

    #[test]
    fn packing_again_gives_the_same_bytes() {
        let once = pack(&cloud(500));
        let twice = pack(&unpack(&once, 500).unwrap());
        let different = once.iter().zip(&twice).filter(|(a, b)| a != b).count();
        assert_eq!((once.len(), different), (twice.len(), 0));
    }

    #[test]
    fn values_that_are_not_finite_become_invisible_and_keep_their_place() {
        let mut surfels = cloud(3);
        surfels.center_m[1] = [f32::NAN, f32::INFINITY, 0.0];
        let mut other = cloud(3);
        other.rotation_wxyz[1] = [0.0; 4];
        other.scale_m[1] = [f32::NAN, -1.0];
        for (surfels, what) in [(surfels, "centre"), (other, "scale")] {
            let after = unpack(&pack(&surfels), 3).unwrap();
            assert_eq!(after.opacity[1], 0.0, "{what}");
            assert!(
                after.iter().all(|s| s.center_m.iter().chain(&s.scale_m).all(|v| v.is_finite())),
                "{what}"
            );
            assert!((after.center_m[2][0] - surfels.center_m[2][0]).abs() < 2e-6, "{what}");
        }
    }

    #[test]
    fn an_empty_cloud_and_one_surfel_come_back() {
        assert_eq!(unpack(&pack(&SurfelCloud::default()), 0).unwrap(), SurfelCloud::default());
        let one = cloud(1);
        assert_eq!(unpack(&pack(&one), 1).unwrap().center_m, one.center_m);
    }

    #[test]
    fn bytes_that_are_none_are_refused_by_name() {
        let bytes = pack(&cloud(4));
        let refused = |bytes: &[u8]| unpack(bytes, 4).unwrap_err().to_string();
        assert_eq!(unpack(&bytes, 3), Err(UnpackError::TooMany { count: 4, max: 3 }));
        assert_eq!(count(&bytes, 3), Err(UnpackError::TooMany { count: 4, max: 3 }));
        for end in 0..bytes.len() {
            assert!(unpack(&bytes[..end], 4).is_err(), "{end}");
        }
        assert!(refused(&[&bytes[..], &[0]].concat()).starts_with("length"));
        let mut other = bytes.clone();
        other[0] = b'X';
        assert!(refused(&other).starts_with("header"));
        let mut other = bytes.clone();
        other[12..16].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(refused(&other).starts_with("box: axis 0"));
        let mut other = bytes;
        other[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(unpack(&other, usize::MAX).unwrap_err().to_string().starts_with("length"));
    }

    #[test]
    fn foreign_bytes_never_panic_and_give_rotations() {
        let mut next = numbers();
        for _ in 0..200 {
            let mut bytes = pack(&cloud(8));
            for byte in bytes.iter_mut().skip(HEADER_BYTES) {
                *byte = (next() * 256.0) as u8;
            }
            for surfel in unpack(&bytes, 8).unwrap().iter() {
                let norm: f32 = surfel.rotation_wxyz.iter().map(|v| v * v).sum();
                assert!((norm - 1.0).abs() < 1e-5, "{surfel:?}");
            }
        }
    }
}
