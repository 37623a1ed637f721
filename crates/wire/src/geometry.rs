//! Poses and 6x6 matrices.

use crate::field::{At, FieldError, Wire, limits};
use crate::v1;
use coma_geometry::{Matrix6, Pose};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// Refuses NaN and infinities.
pub fn finite(value: f64, at: &At<'_>) -> Result<f64, FieldError> {
    if value.is_finite() { Ok(value) } else { Err(at.refuse(format!("{value} is not finite"))) }
}

impl Wire for Pose {
    type Message = v1::Pose;

    fn to_wire(&self) -> v1::Pose {
        let (t, q) = (&self.translation.vector, &self.rotation.coords);
        v1::Pose { tx_m: t.x, ty_m: t.y, tz_m: t.z, qx: q.x, qy: q.y, qz: q.z, qw: q.w }
    }

    /// A quaternion within 1e-9 of unit length is kept bit for bit, within 1e-4 (single precision,
    /// rounded text) it is normalised, else refused.
    fn from_wire(m: v1::Pose, at: &At<'_>) -> Result<Self, FieldError> {
        for (name, value) in [("tx_m", m.tx_m), ("ty_m", m.ty_m), ("tz_m", m.tz_m)] {
            if !(value.abs() <= limits::DISTANCE_M) {
                return Err(at.field(name).refuse(format!("{value} is not within 1e7 m of the origin")));
            }
        }
        let quaternion = Quaternion::new(m.qw, m.qx, m.qy, m.qz);
        let norm = quaternion.norm();
        let rotation = if (norm - 1.0).abs() <= 1e-9 {
            UnitQuaternion::new_unchecked(quaternion)
        } else if (norm - 1.0).abs() <= 1e-4 {
            UnitQuaternion::new_normalize(quaternion)
        } else {
            return Err(at.refuse(format!("quaternion (qx, qy, qz, qw) has length {norm}, not 1")));
        };
        Ok(Isometry3::from_parts(Translation3::new(m.tx_m, m.ty_m, m.tz_m), rotation))
    }
}

impl Wire for Matrix6 {
    type Message = v1::Symmetric6;

    fn to_wire(&self) -> v1::Symmetric6 {
        let upper_triangle = (0..6).flat_map(|row| (row..6).map(move |column| self[(row, column)])).collect();
        v1::Symmetric6 { upper_triangle }
    }

    /// Information and covariance matrices: finite, no negative eigenvalue beyond rounding.
    fn from_wire(m: v1::Symmetric6, at: &At<'_>) -> Result<Self, FieldError> {
        let values = m.upper_triangle;
        let at = at.field("upper_triangle");
        if values.len() != 21 {
            return Err(at.refuse(format!("{} numbers, 21 are needed", values.len())));
        }
        let mut out = Matrix6::zeros();
        let mut next = values.into_iter().enumerate();
        for row in 0..6 {
            for column in row..6 {
                let (i, value) = next.next().expect("21 numbers");
                if !(value.abs() <= 1e30) {
                    return Err(at.index(i).refuse(format!("{value} is not finite or over 1e30")));
                }
                out[(row, column)] = value;
                out[(column, row)] = value;
            }
        }
        // Scaled to a unit diagonal, so that metres and radians of very different size are judged alike.
        let scale = out.diagonal().map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { 1.0 });
        let scaled = Matrix6::from_fn(|r, c| out[(r, c)] * scale[r] * scale[c]);
        let smallest = scaled.symmetric_eigenvalues().min();
        if !(smallest >= -1e-6) {
            return Err(at.refuse(format!("not positive semi-definite (scaled eigenvalue {smallest:.3e})")));
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose() -> v1::Pose {
        Pose::new(nalgebra::Vector3::new(1.0, -2.0, 3.0), nalgebra::Vector3::new(0.3, 0.2, -0.1)).to_wire()
    }

    #[test]
    fn poses_keep_their_bits() {
        let read = Pose::from_wire(pose(), &At::ROOT).unwrap();
        assert_eq!(read.to_wire(), pose());
    }

    #[test]
    fn a_pose_that_is_none_is_refused_by_name() {
        let at = At::Root("from_from_to");
        let refused = |m| Pose::from_wire(m, &at).unwrap_err().field;
        assert_eq!(refused(v1::Pose { ty_m: f64::NAN, ..pose() }), "from_from_to.ty_m");
        assert_eq!(refused(v1::Pose { tz_m: f64::INFINITY, ..pose() }), "from_from_to.tz_m");
        assert_eq!(refused(v1::Pose { qw: 0.0, ..pose() }), "from_from_to");
        assert_eq!(refused(v1::Pose { qx: f64::NAN, ..pose() }), "from_from_to");
        assert_eq!(refused(v1::Pose::default()), "from_from_to");
    }

    #[test]
    fn a_single_precision_quaternion_is_normalised() {
        let m = pose();
        let single = |v: f64| f64::from(v as f32);
        let rounded =
            v1::Pose { qx: single(m.qx), qy: single(m.qy), qz: single(m.qz), qw: single(m.qw), ..m };
        let read = Pose::from_wire(rounded, &At::ROOT).unwrap();
        assert!((read.rotation.quaternion().norm() - 1.0).abs() < 1e-15);
    }

    #[test]
    fn matrices_keep_their_bits_and_must_not_be_negative() {
        let m = Matrix6::from_fn(|r, c| if r == c { 10f64.powi(r as i32 * 2) } else { 0.01 });
        assert_eq!(Matrix6::from_wire(m.to_wire(), &At::ROOT).unwrap(), m);
        let at = At::Root("information");
        let refused = |m: Matrix6| Matrix6::from_wire(m.to_wire(), &at).unwrap_err().field;
        assert_eq!(refused(-m), "information.upper_triangle");
        assert_eq!(refused(m * f64::NAN), "information.upper_triangle[0]");
        let short = v1::Symmetric6 { upper_triangle: vec![1.0; 20] };
        assert!(Matrix6::from_wire(short, &at).unwrap_err().message.contains("21"));
    }
}
