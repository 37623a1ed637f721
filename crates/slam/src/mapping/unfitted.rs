//! Seeds that are not fitted to the surface: what surface-fitting initialisation (eq. 6 to 8) is compared with.

use nalgebra::{Quaternion, UnitQuaternion};

/// A rotation that is uniform over all, from a seed and the pixel that it is for: the same on every machine and in
/// every order.
pub fn random_rotation(seed: u64, sequence: u64, x: usize, y: usize) -> UnitQuaternion<f32> {
    let mut state = mixed(seed ^ mixed(sequence ^ mixed((y as u64) << 32 | x as u64)));
    let mut next = || {
        state = mixed(state);
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    // Shoemake, "Uniform random rotations" (1992).
    let (u, v, w) = (next(), std::f32::consts::TAU * next(), std::f32::consts::TAU * next());
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    UnitQuaternion::from_quaternion(Quaternion::new(b * w.cos(), a * v.sin(), a * v.cos(), b * w.sin()))
}

/// SplitMix64's step (Steele, Lea, Flood 2014).
fn mixed(value: u64) -> u64 {
    let z = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn rotations_depend_on_seed_frame_and_pixel_alone_and_favour_no_direction() {
        assert_eq!(random_rotation(1, 2, 3, 4), random_rotation(1, 2, 3, 4));
        for other in [(2, 2, 3, 4), (1, 3, 3, 4), (1, 2, 4, 3), (1, 2, 3, 5)] {
            assert_ne!(random_rotation(1, 2, 3, 4), random_rotation(other.0, other.1, other.2, other.3));
        }
        let normals = || (0..2500).map(|i| random_rotation(7, 0, i % 50, i / 50) * Vector3::z());
        let mean: Vector3<f32> = normals().sum::<Vector3<f32>>() / 2500.0;
        assert!(mean.norm() < 0.05, "{mean}");
        let spread: Vector3<f32> = normals().map(|n| n.component_mul(&n)).sum::<Vector3<f32>>() / 2500.0;
        assert!((spread - Vector3::repeat(1.0 / 3.0)).norm() < 0.03, "{spread}");
    }
}
