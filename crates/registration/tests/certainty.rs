//! Is the information of an alignment to be believed? Accepted motions of the built-in world against the truth.

use coma_dataset::Sequence as _;
use coma_dataset::world::{SensorNoise, World, WorldSettings};
use coma_geometry::{Pose, se3};
use coma_registration::{Outcome, Prepared, Settings, Side, View, align_prepared};

/// Squared errors of all accepted pairs among frames of two agents, by their information. Six parameters: 6 on
/// average if it is right.
fn squared_errors(noise: Option<SensorNoise>) -> Vec<f64> {
    const FRAMES: usize = 200;
    let world =
        World::new(WorldSettings { agents: 2, frames: FRAMES, noise, ..WorldSettings::default() }).unwrap();
    let settings = Settings::default();
    let mut views: Vec<(Prepared, Pose)> = Vec::new();
    for agent in 0..2 {
        let sequence = world.sequence(agent).unwrap();
        for index in (0..FRAMES).step_by(25) {
            let frame = coma_dataset::sequence::rgbd_frame(&sequence, index).unwrap();
            let prepared = Prepared::new(&View::from_frame(&frame), &settings, Side::Source).unwrap();
            views.push((prepared, sequence.truth(index).unwrap()));
        }
    }
    let mut out = Vec::new();
    for (i, (source, world_from_source)) in views.iter().enumerate() {
        for (target, world_from_target) in &views[i + 1..] {
            if let Outcome::Accepted(found) = align_prepared(source, target, &settings, 7) {
                let truth = world_from_target.inv_mul(world_from_source);
                let xi = se3::log(&truth.inv_mul(&found.target_from_source));
                out.push((xi.transpose() * found.information * xi)[0]);
            }
        }
    }
    out
}

fn assert_calibrated(squared: &[f64]) {
    let mean = squared.iter().sum::<f64>() / squared.len() as f64;
    println!("mean {mean:.2} of {} accepted pairs", squared.len());
    assert!(squared.len() >= 30, "{} pairs", squared.len());
    assert!((3.0..=12.0).contains(&mean), "{mean}");
}

#[test]
fn accepted_motions_are_as_certain_as_they_claim() {
    assert_calibrated(&squared_errors(None));
}

#[test]
fn so_they_are_with_a_noisy_sensor() {
    assert_calibrated(&squared_errors(Some(SensorNoise::default())));
}
