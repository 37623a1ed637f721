//! What the built-in world promises to those who test with it.

use coma_dataset::sequence::rgbd_frame;
use coma_dataset::world::scene::V3;
use coma_dataset::world::{SensorNoise, World, WorldSettings};
use coma_dataset::{ColorBytes, DepthBytes, Sequence};
use coma_frame::normals::normals_from_depth;
use coma_geometry::nalgebra::{Matrix6, Point3, SymmetricEigen, Vector3, Vector6};
use coma_geometry::{Pose, se3};
use std::sync::LazyLock;

/// Frames in which agents are to meet.
const DEMO_FRAMES: usize = 200;

static WORLD: LazyLock<World> = LazyLock::new(|| {
    World::new(WorldSettings { agents: 8, frames: 900, ..Default::default() }).expect("default settings")
});

fn poses(agent: usize, frames: usize) -> Vec<Pose> {
    let sequence = WORLD.sequence(agent).unwrap();
    (0..frames).map(|i| sequence.truth(i).unwrap()).collect()
}

#[test]
fn cameras_move_as_if_held_by_hand() {
    for agent in 0..8 {
        let poses = poses(agent, 900);
        let steps: Vec<(f64, f64)> = poses.windows(2).map(|w| se3::distance(&w[0], &w[1])).collect();
        let max_m = steps.iter().map(|s| s.0).fold(0.0, f64::max);
        let max_deg = steps.iter().map(|s| s.1).fold(0.0, f64::max).to_degrees();
        assert!(max_m < 0.025 && max_deg < 1.6, "agent {agent}: {max_m} m, {max_deg} degrees in one frame");
        let mean_deg = steps.iter().map(|s| s.1.to_degrees()).sum::<f64>() / steps.len() as f64;
        assert!((0.4..1.0).contains(&mean_deg), "agent {agent}: {mean_deg} degrees a frame");
        // No jerks either: steps change slowly.
        for w in poses.windows(3) {
            let (a, b) = (w[0].inverse() * w[1], w[1].inverse() * w[2]);
            let (metres, radians) = se3::distance(&a, &b);
            assert!(metres < 0.006 && radians.to_degrees() < 0.4, "agent {agent}: {metres} m, {radians} rad");
        }
    }
}

#[test]
fn cameras_keep_clear_of_walls_and_furniture() {
    for agent in 0..8 {
        for (i, pose) in poses(agent, 900).iter().enumerate().step_by(3) {
            let at: V3 = pose.translation.vector.cast();
            for k in 0..64 {
                // Directions spread evenly over the sphere.
                let z = 1.0 - (2.0 * k as f32 + 1.0) / 64.0;
                let angle = k as f32 * 2.399_963;
                let flat = (1.0 - z * z).sqrt();
                let direction = V3::new(flat * angle.cos(), flat * angle.sin(), z);
                let free_m = WORLD.scene().free_share(&at, &direction, 1.0);
                assert!(free_m > 0.25, "agent {agent} frame {i}: {free_m} m of room");
            }
        }
    }
}

/// Frames of `a` in which it is within 0.5 m and 30 degrees of some frame of `b`.
fn meetings(a: &[Pose], b: &[Pose]) -> Vec<usize> {
    let near = |p: &Pose, q: &Pose| {
        let (metres, _) = se3::distance(p, q);
        let cosine = (p.rotation * Vector3::z()).dot(&(q.rotation * Vector3::z()));
        metres < 0.5 && cosine > 30f64.to_radians().cos()
    };
    (0..a.len()).filter(|i| b.iter().any(|q| near(&a[*i], q))).collect()
}

#[test]
fn agents_start_apart_and_see_the_same_places_within_200_frames() {
    let walks: Vec<_> = (0..4).map(|agent| poses(agent, DEMO_FRAMES)).collect();
    for a in 0..4 {
        for b in 0..4 {
            if a == b {
                continue;
            }
            let (metres, _) = se3::distance(&walks[a][0], &walks[b][0]);
            assert!(metres > 1.0, "{a} and {b} start {metres} m apart");
            let met = meetings(&walks[a], &walks[b]);
            assert!(met.len() >= 40, "{a} meets {b} in {} frames", met.len());
            // Two loops count as independent if they lie more than 20 frames apart.
            assert!(met[met.len() - 1] - met[0] > 40, "{a} meets {b} only in {met:?}");
        }
    }
}

#[test]
fn depth_and_pose_agree_between_views() {
    // A pixel carried into a later view by depth and truth is seen there at the depth that it should have.
    let sequence = WORLD.sequence(0).unwrap();
    let (first, second) = (rgbd_frame(&sequence, 40).unwrap(), rgbd_frame(&sequence, 50).unwrap());
    let second_from_first = sequence.truth(50).unwrap().inverse() * sequence.truth(40).unwrap();
    let (mut seen, mut agree, mut color_difference) = (0, 0, 0.0);
    for y in (4..236).step_by(3) {
        for x in (4..316).step_by(3) {
            let point = first.camera.back_project(x as f64, y as f64, first.depth_m[(x, y)] as f64);
            let moved = second_from_first * point;
            let Some(pixel) = second.camera.project(&moved) else { continue };
            let (u, v) = (pixel.x.round(), pixel.y.round());
            if !(u >= 0.0 && v >= 0.0 && u < 320.0 && v < 240.0) {
                continue;
            }
            seen += 1;
            let z = second.depth_m[(u as usize, v as usize)] as f64;
            if (z - moved.z).abs() < 0.02 * moved.z {
                agree += 1;
                let (p, q) = (first.color[(x, y)], second.color[(u as usize, v as usize)]);
                color_difference += (p[1] as f64 - q[1] as f64).abs();
            }
        }
    }
    assert!(seen > 5000, "{seen}");
    assert!(agree as f64 > 0.95 * seen as f64, "{agree} of {seen}");
    assert!(color_difference / (agree as f64) < 8.0, "{}", color_difference / agree as f64);
}

/// The least of the six eigenvalues of point-to-plane alignment's normal matrix, per pixel, with points
/// centred and scaled to unit spread: 0 if some motion can't be seen in the depth.
fn weakest_direction(frame: &coma_frame::RgbdFrame) -> f64 {
    let normals = normals_from_depth(&frame.depth_m, &frame.camera, 0.05, 2);
    let mut pairs = Vec::new();
    for y in (0..240).step_by(4) {
        for x in (0..320).step_by(4) {
            let n = normals[(x, y)];
            if n != [0.0; 3] {
                let p = frame.camera.back_project(x as f64, y as f64, frame.depth_m[(x, y)] as f64);
                pairs.push((p, Vector3::new(n[0] as f64, n[1] as f64, n[2] as f64)));
            }
        }
    }
    let count = pairs.len() as f64;
    let centre = pairs.iter().map(|(p, _)| p.coords).sum::<Vector3<f64>>() / count;
    let spread = (pairs.iter().map(|(p, _)| (p.coords - centre).norm_squared()).sum::<f64>() / count).sqrt();
    let mut hessian = Matrix6::zeros();
    for (p, n) in pairs {
        let arm = (p - Point3::from(centre)).cross(&n) / spread;
        let row = Vector6::new(n.x, n.y, n.z, arm.x, arm.y, arm.z);
        hessian += row * row.transpose() / count;
    }
    SymmetricEigen::new(hessian).eigenvalues.min()
}

#[test]
fn nearly_every_view_fixes_all_six_degrees_of_freedom_and_is_textured() {
    let (mut views, mut weak, mut bland) = (0, Vec::new(), Vec::new());
    for agent in 0..4 {
        let sequence = WORLD.sequence(agent).unwrap();
        for index in (0..600).step_by(40) {
            let frame = rgbd_frame(&sequence, index).unwrap();
            assert!(frame.depth_coverage() > 0.999, "agent {agent} frame {index} sees out of the rooms");
            views += 1;
            let weakest = weakest_direction(&frame);
            if weakest < 0.004 {
                weak.push((agent, index, weakest));
            }
            let gray = frame.color.luminance();
            let mut textured = 0;
            for y in 0..239 {
                for x in 0..319 {
                    let (dx, dy) = (gray[(x + 1, y)] - gray[(x, y)], gray[(x, y + 1)] - gray[(x, y)]);
                    textured += usize::from(dx.abs().max(dy.abs()) > 3.0 / 255.0);
                }
            }
            if textured < 320 * 240 / 5 {
                bland.push((agent, index, textured));
            }
        }
    }
    assert!(weak.len() * 20 <= views, "{} of {views} views are weak: {weak:?}", weak.len());
    assert!(bland.len() * 10 <= views, "{} of {views} views are bland: {bland:?}", bland.len());
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_other_ones() {
    let small =
        WorldSettings { width: 64, height: 48, noise: Some(SensorNoise::default()), ..Default::default() };
    let frame = |settings| World::new(settings).unwrap().sequence(1).unwrap().frame(17).unwrap();
    let first = frame(small);
    assert_eq!(first, frame(WorldSettings { agents: 3, frames: 90, ..small }));
    assert_ne!(first, frame(WorldSettings { seed: 2, ..small }));
}

#[test]
fn noise_is_as_large_as_its_settings_say() {
    let noise = SensorNoise::default();
    let noisy = World::new(WorldSettings { agents: 1, noise: Some(noise), ..Default::default() }).unwrap();
    let (clean, noisy) = (WORLD.sequence(0).unwrap(), noisy.sequence(0).unwrap());
    let (clean, noisy) = (rgbd_frame(&clean, 0).unwrap(), rgbd_frame(&noisy, 0).unwrap());
    let (mut sum, mut count) = (0.0, 0.0);
    for (z, measured) in clean.depth_m.pixels().iter().zip(noisy.depth_m.pixels()) {
        if *measured > 0.0 {
            sum += ((measured - z) / noise.depth.sigma_m(*z)).powi(2) as f64;
            count += 1.0;
        }
    }
    // Rounding to steps of one deviation adds 1/12 to the variance.
    let ratio: f64 = sum / count;
    assert!((1.0..1.2).contains(&ratio), "variance over the setting's: {ratio}");
    let coverage = noisy.depth_coverage();
    assert!((0.8..0.99).contains(&coverage), "{coverage}");
}

#[test]
fn bad_settings_are_named() {
    let refused = |s| World::new(s).unwrap_err().to_string();
    let base = WorldSettings::default();
    assert!(refused(WorldSettings { agents: 9, ..base }).contains("agents = 9"));
    assert!(refused(WorldSettings { frames: 0, ..base }).contains("frames = 0"));
    assert!(refused(WorldSettings { width: 4, ..base }).contains("width = 4"));
    assert!(refused(WorldSettings { frames_per_second: f64::NAN, ..base }).contains("frames_per_second"));
}

#[test]
fn frames_beyond_the_end_are_refused() {
    let sequence = WORLD.sequence(0).unwrap();
    assert!(sequence.frame(900).is_err() && sequence.truth(900).is_none());
    assert!(WORLD.sequence(8).is_none());
    let frame = sequence.frame(899).unwrap();
    assert!(matches!((frame.color, frame.depth), (ColorBytes::Rgb8(_), DepthBytes::Raw16(_))));
}
