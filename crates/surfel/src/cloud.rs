//! Surfels as values and as columns.

use coma_geometry::Pose;
use nalgebra::{Matrix3, Point3, Quaternion, UnitQuaternion};

/// One surfel: a disc with centre, two tangent axes and a normal (the columns of its rotation), in the
/// frame of its submap. Eq. 6 to 8 of the CoMA-SLAM paper say how one is made from a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surfel {
    /// Centre, metres.
    pub center_m: [f32; 3],
    /// Rotation of the disc `(e1, e2, normal)` in its submap, a unit quaternion `w, x, y, z`.
    pub rotation_wxyz: [f32; 4],
    /// Standard deviations along `e1` and `e2`, metres.
    pub scale_m: [f32; 2],
    /// 0..1.
    pub opacity: f32,
    /// RGB, 0..1.
    pub color: [f32; 3],
}

/// Surfels as columns (structure of arrays); every column has the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SurfelCloud {
    /// Centres, metres. `[n, 3]`
    pub center_m: Vec<[f32; 3]>,
    /// Unit quaternions w, x, y, z. `[n, 4]`
    pub rotation_wxyz: Vec<[f32; 4]>,
    /// Standard deviations along the two tangents, metres. `[n, 2]`
    pub scale_m: Vec<[f32; 2]>,
    /// 0..1. `[n]`
    pub opacity: Vec<f32>,
    /// RGB, 0..1. `[n, 3]`
    pub color: Vec<[f32; 3]>,
}

impl SurfelCloud {
    /// Bytes that one surfel takes.
    pub const SURFEL_BYTES: usize = 13 * size_of::<f32>();

    /// Empty, with room for `count`.
    pub fn with_capacity(count: usize) -> Self {
        SurfelCloud {
            center_m: Vec::with_capacity(count),
            rotation_wxyz: Vec::with_capacity(count),
            scale_m: Vec::with_capacity(count),
            opacity: Vec::with_capacity(count),
            color: Vec::with_capacity(count),
        }
    }

    /// Number of surfels.
    pub fn len(&self) -> usize {
        self.center_m.len()
    }

    /// True without surfels.
    pub fn is_empty(&self) -> bool {
        self.center_m.is_empty()
    }

    /// Appends one.
    pub fn push(&mut self, surfel: Surfel) {
        self.center_m.push(surfel.center_m);
        self.rotation_wxyz.push(surfel.rotation_wxyz);
        self.scale_m.push(surfel.scale_m);
        self.opacity.push(surfel.opacity);
        self.color.push(surfel.color);
    }

    /// The surfel at `index`.
    pub fn get(&self, index: usize) -> Surfel {
        Surfel {
            center_m: self.center_m[index],
            rotation_wxyz: self.rotation_wxyz[index],
            scale_m: self.scale_m[index],
            opacity: self.opacity[index],
            color: self.color[index],
        }
    }

    /// All surfels, in order.
    pub fn iter(&self) -> impl Iterator<Item = Surfel> + '_ {
        (0..self.len()).map(|i| self.get(i))
    }

    /// Keeps the surfels for which `keep[i]` holds, in order.
    ///
    /// # Panics
    /// If `keep` has another length.
    pub fn retain(&mut self, keep: &[bool]) {
        assert_eq!(keep.len(), self.len(), "one flag for each surfel");
        fn column<T: Copy>(values: &mut Vec<T>, keep: &[bool]) {
            let mut i = 0;
            values.retain(|_| {
                i += 1;
                keep[i - 1]
            });
        }
        column(&mut self.center_m, keep);
        column(&mut self.rotation_wxyz, keep);
        column(&mut self.scale_m, keep);
        column(&mut self.opacity, keep);
        column(&mut self.color, keep);
    }
}

impl FromIterator<Surfel> for SurfelCloud {
    fn from_iter<I: IntoIterator<Item = Surfel>>(surfels: I) -> Self {
        let mut cloud = SurfelCloud::default();
        for surfel in surfels {
            cloud.push(surfel);
        }
        cloud
    }
}

impl Surfel {
    /// The same surfel in another frame of reference. Colour does not depend on where it is seen from.
    pub fn moved(&self, target_from_source: &Pose) -> Surfel {
        let [x, y, z] = self.center_m.map(f64::from);
        let center = target_from_source * Point3::new(x, y, z);
        let [qw, qx, qy, qz] = self.rotation_wxyz.map(f64::from);
        let q = target_from_source.rotation.quaternion() * Quaternion::new(qw, qx, qy, qz);
        Surfel {
            center_m: [center.x as f32, center.y as f32, center.z as f32],
            rotation_wxyz: [q.w as f32, q.i as f32, q.j as f32, q.k as f32],
            ..*self
        }
    }

    /// True if every value is finite.
    pub fn is_finite(&self) -> bool {
        let Surfel { center_m, rotation_wxyz, scale_m, opacity, color } = self;
        let values = center_m.iter().chain(rotation_wxyz).chain(scale_m).chain([opacity]).chain(color);
        values.copied().all(f32::is_finite)
    }

    /// The rotation as a matrix with columns `e1, e2, normal`.
    pub fn rotation(&self) -> Matrix3<f32> {
        let [w, x, y, z] = self.rotation_wxyz;
        *UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix().matrix()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SURFEL: Surfel = Surfel {
        center_m: [1.0, 2.0, 3.0],
        rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
        scale_m: [0.01, 0.02],
        opacity: 0.5,
        color: [0.1, 0.2, 0.3],
    };

    #[test]
    fn rotation_is_w_x_y_z_and_its_columns_are_the_tangents_and_the_normal() {
        assert_eq!(SURFEL.rotation(), Matrix3::identity());
        // A quarter turn about x, (cos 45, sin 45, 0, 0), turns the second tangent to z and the normal to -y.
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let turned = Surfel { rotation_wxyz: [half, half, 0.0, 0.0], ..SURFEL }.rotation();
        let expected = Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
        assert!((turned - expected).norm() < 1e-6, "{turned}");
    }

    #[test]
    fn a_moved_surfel_lies_where_its_points_go() {
        let target_from_source =
            coma_geometry::se3::exp(&coma_geometry::Tangent::new(1.0, -2.0, 0.5, 0.3, 1.0, -0.4));
        let moved = SURFEL.moved(&target_from_source);
        // A point one scale along the first tangent, moved either way.
        let along = |s: &Surfel| {
            let e1 = s.rotation().column(0) * s.scale_m[0];
            Point3::new(s.center_m[0] + e1.x, s.center_m[1] + e1.y, s.center_m[2] + e1.z).cast::<f64>()
        };
        assert!((target_from_source * along(&SURFEL) - along(&moved)).norm() < 1e-6);
        let back = moved.moved(&target_from_source.inverse());
        assert!(back.center_m.iter().zip(SURFEL.center_m).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    #[test]
    fn columns_give_back_the_surfels_in_order_and_stay_equally_long() {
        let other = Surfel { opacity: 0.25, ..SURFEL };
        let mut cloud: SurfelCloud = [SURFEL, other, SURFEL].into_iter().collect();
        assert_eq!(cloud.iter().collect::<Vec<_>>(), [SURFEL, other, SURFEL]);
        cloud.retain(&[false, true, true]);
        assert_eq!(cloud.iter().collect::<Vec<_>>(), [other, SURFEL]);
    }
}
