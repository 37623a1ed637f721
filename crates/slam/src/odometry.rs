//! How sure the motion from one submap to the next is.

use crate::tracking::Tracked;
use coma_frame::RgbdFrame;
use coma_geometry::{Matrix6, Pose, se3};

/// Drift of tracking across a submap, standard deviations by metre and by radian of its way. Calibrated, as all
/// numbers here, on the built-in world with an ideal and with a noisy sensor and on a rendered room: the mean squared
/// normalised error of edges stays under 12.
const METRES_PER_METRE: f64 = 0.0003;
const METRES_PER_RADIAN: f64 = 0.0001;
const RADIANS_PER_RADIAN: f64 = 0.0003;
const RADIANS_PER_METRE: f64 = 0.0001;
/// Drift that the sensor causes: standard deviations of its depth, where the frame's typical depth lies and as large as
/// the frame shows them to be. The map that is tracked against carries the noise of the frames that it was made of, and
/// fusion averages a part of it out.
const NOISE_SHARE: f64 = 0.5;
/// The same for rotation, in units of the noise seen from the typical depth.
const ROTATION_NOISE_SHARE: f64 = 0.75;
/// Pixels between two that are looked at for the typical depth.
const STEP: usize = 8;

/// Information of `from_from_to`, perturbed on the right. `frame` is the first of the new submap, and `tracked` says how
/// well that one frame was found; the rest is drift along the way.
pub fn information(from_from_to: &Pose, tracked: &Tracked, frame: &RgbdFrame) -> Matrix6 {
    let (metres, radians) = se3::distance(&Pose::identity(), from_from_to);
    let depth_m = typical_depth_m(frame);
    let noise_m = tracked.noise_ratio * frame.noise.sigma_m(depth_m) as f64;
    let noise_rad = noise_m / depth_m as f64;
    let drift_m = METRES_PER_METRE * metres + METRES_PER_RADIAN * radians;
    let drift_rad = RADIANS_PER_RADIAN * radians + RADIANS_PER_METRE * metres;
    let mut covariance = tracked.covariance;
    for axis in 0..3 {
        covariance[(axis, axis)] += drift_m.powi(2) + (NOISE_SHARE * noise_m).powi(2);
        covariance[(axis + 3, axis + 3)] += drift_rad.powi(2) + (ROTATION_NOISE_SHARE * noise_rad).powi(2);
    }
    let information = covariance.try_inverse().unwrap_or_else(Matrix6::identity);
    (information + information.transpose()) * 0.5
}

/// The middle of the measured depths, metres; 1 without any.
fn typical_depth_m(frame: &RgbdFrame) -> f32 {
    let depth_m = &frame.depth_m;
    let rows = (0..depth_m.height()).step_by(STEP);
    let mut measured: Vec<f32> =
        rows.flat_map(|y| depth_m.row(y).iter().step_by(STEP)).copied().filter(|z| *z > 0.0).collect();
    if measured.is_empty() {
        return 1.0;
    }
    let middle = measured.len() / 2;
    *measured.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::align::Brightness;
    use coma_frame::{DepthNoise, Image};
    use coma_geometry::{Intrinsics, StampNs, Tangent};

    fn frame(depth_m: f32, noise: DepthNoise) -> RgbdFrame {
        let camera = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };
        let (color, depth) = (Image::filled(32, 24, [90; 3]), Image::filled(32, 24, depth_m));
        RgbdFrame::new(0, StampNs(0), camera, noise, color, depth).unwrap()
    }

    fn tracked(noise_ratio: f64, covariance: Matrix6) -> Tracked {
        Tracked {
            agent_from_camera: Pose::identity(),
            brightness: Brightness::default(),
            covariance,
            share: 1.0,
            agreement: 1.0,
            noise_ratio,
            map_at_once: false,
            hits: 0,
        }
    }

    fn deviations(way_m: f64, noise_ratio: f64, frame: &RgbdFrame) -> (f64, f64) {
        let way = se3::exp(&Tangent::new(way_m, 0.0, 0.0, 0.0, 0.1, 0.0));
        let tracked = tracked(noise_ratio, Matrix6::identity() * 1e-12);
        let covariance = information(&way, &tracked, frame).try_inverse().unwrap();
        (covariance[(0, 0)].sqrt(), covariance[(5, 5)].sqrt())
    }

    #[test]
    fn a_longer_way_and_a_noisier_sensor_leave_less_certainty() {
        let clean = DepthNoise { base_m: 1e-5, quadratic_per_m: 0.0 };
        let near = deviations(0.2, 1.0, &frame(1.0, clean));
        let far = deviations(2.0, 1.0, &frame(1.0, clean));
        assert!(far.0 > 5.0 * near.0 && far.1 > 2.0 * near.1, "{near:?} {far:?}");
        let noisy = deviations(0.2, 1.0, &frame(1.0, DepthNoise::default()));
        let deep = deviations(0.2, 1.0, &frame(3.0, DepthNoise::default()));
        assert!(noisy.0 > 2.0 * near.0 && deep.0 > 4.0 * noisy.0, "{near:?} {noisy:?} {deep:?}");
        // Frames that fit better than the sensor is said to see say that it sees better.
        let better = deviations(0.2, 0.1, &frame(3.0, DepthNoise::default()));
        assert!(better.0 < 0.2 * deep.0 && better.1 < 0.2 * deep.1, "{deep:?} {better:?}");
    }

    #[test]
    fn a_frame_without_depth_and_a_singular_covariance_are_borne() {
        let blind = frame(0.0, DepthNoise::default());
        let information = information(&Pose::identity(), &tracked(1.0, Matrix6::zeros()), &blind);
        assert!(information.iter().all(|v| v.is_finite()) && information.cholesky().is_some());
    }
}
