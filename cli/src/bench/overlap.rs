//! How much two frames truly share, by their depth and true poses.

use anyhow::Context;
use coma_dataset::Sequence;
use coma_frame::{Image, RgbdFrame};
use coma_geometry::nalgebra::Point3;
use coma_geometry::{Intrinsics, Pose};

/// Pixels between two points that are looked at.
const STEP: usize = 16;
/// Depth of points that are looked at, metres.
const DEPTH_M: std::ops::Range<f32> = 0.3..6.0;

/// What a frame saw, and from where.
pub struct Sight {
    camera: Intrinsics,
    depth_m: Image<f32>,
    map_from_camera: Pose,
    points: Vec<Point3<f64>>,
}

impl Sight {
    /// Frame `index` of a sequence whose true poses are known, and what it saw.
    pub fn of(sequence: &dyn Sequence, index: usize) -> anyhow::Result<(Sight, RgbdFrame)> {
        let truth = sequence.truth(index).with_context(|| format!("frame {index} has no true pose"))?;
        let frame = coma_dataset::sequence::rgbd_frame(sequence, index)?;
        Ok((Sight::new(frame.camera, frame.depth_m.clone(), truth), frame))
    }

    fn new(camera: Intrinsics, depth_m: Image<f32>, map_from_camera: Pose) -> Sight {
        let mut points = Vec::new();
        for y in (STEP / 2..depth_m.height()).step_by(STEP) {
            for x in (STEP / 2..depth_m.width()).step_by(STEP) {
                let z = depth_m[(x, y)];
                if z > DEPTH_M.start && z < DEPTH_M.end {
                    points.push(camera.back_project(x as f64, y as f64, z as f64));
                }
            }
        }
        Sight { camera, depth_m, map_from_camera, points }
    }

    /// Share of this frame's points that the other sees at its own depth.
    fn seen_by(&self, other: &Sight) -> f64 {
        let other_from_self = other.map_from_camera.inv_mul(&self.map_from_camera);
        let (width, height) = (other.depth_m.width() as f64, other.depth_m.height() as f64);
        let seen = |point: &&Point3<f64>| {
            let p = other_from_self * **point;
            let Some(pixel) = other.camera.project(&p).filter(|_| p.z > 0.1) else { return false };
            let (u, v) = (pixel.x.round_ties_even(), pixel.y.round_ties_even());
            if !(u >= 0.0 && v >= 0.0 && u < width && v < height) {
                return false;
            }
            let there = other.depth_m[(u as usize, v as usize)] as f64;
            there > 0.0 && (there - p.z).abs() < 0.1 + 0.03 * p.z
        };
        self.points.iter().filter(seen).count() as f64 / self.points.len().max(1) as f64
    }

    /// The lesser of both directions.
    pub fn mutual(&self, other: &Sight) -> f64 {
        self.seen_by(other).min(other.seen_by(self))
    }

    /// `other_from_self`, by the true poses.
    pub fn motion_to(&self, other: &Sight) -> Pose {
        other.map_from_camera.inv_mul(&self.map_from_camera)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{Tangent, se3};

    /// A wall 2 m ahead, seen from `x` metres to the right.
    fn wall(x: f64) -> Sight {
        let camera = Intrinsics { width: 320, height: 240, fx: 160.0, fy: 160.0, cx: 160.0, cy: 120.0 };
        let right = se3::exp(&Tangent::new(x, 0.0, 0.0, 0.0, 0.0, 0.0));
        Sight::new(camera, Image::filled(320, 240, 2.0), right)
    }

    #[test]
    fn overlap_is_the_share_that_both_see() {
        assert_eq!(wall(0.0).mutual(&wall(0.0)), 1.0);
        // The wall is 4 m wide: half of it is seen from 2 m aside.
        assert!((wall(0.0).mutual(&wall(2.0)) - 0.5).abs() < 0.06);
        assert_eq!(wall(0.0).mutual(&wall(5.0)), 0.0);
        let moved = wall(0.0).motion_to(&wall(2.0)).translation.vector;
        assert!((moved.x + 2.0).abs() < 1e-12);
    }
}
