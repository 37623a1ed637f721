//! How right are alignments, and is their information to be believed? Accepted motions of the built-in world against
//! the truth.

use coma_dataset::Sequence as _;
use coma_dataset::world::{SensorNoise, World, WorldSettings};
use coma_geometry::{Pose, Tangent, se3};
use coma_registration::settings::PixelScale;
use coma_registration::{Alignment, Outcome, Prepared, Settings, Side, View, align_prepared, refine};

const FRAMES: usize = 200;

/// Every 25th frame of two agents, with its true pose.
fn views(noise: Option<SensorNoise>) -> Vec<(Prepared, Pose)> {
    let world =
        World::new(WorldSettings { agents: 2, frames: FRAMES, noise, ..WorldSettings::default() }).unwrap();
    let view = |agent, index| {
        let sequence = world.sequence(agent).unwrap();
        let frame = coma_dataset::sequence::rgbd_frame(&sequence, index).unwrap();
        let prepared = Prepared::new(&View::from_frame(&frame), &Settings::default(), Side::Source).unwrap();
        (prepared, sequence.truth(index).unwrap())
    };
    (0..2)
        .flat_map(|agent| (0..FRAMES).step_by(25).map(move |index| (agent, index)))
        .map(|(a, i)| view(a, i))
        .collect()
}

/// All accepted pairs, with the true motion of each.
fn accepted(noise: Option<SensorNoise>) -> Vec<(Pose, Box<Alignment>)> {
    let views = views(noise);
    let mut out = Vec::new();
    for (i, (source, world_from_source)) in views.iter().enumerate() {
        for (target, world_from_target) in &views[i + 1..] {
            if let Outcome::Accepted(found) = align_prepared(source, target, &Settings::default(), 7) {
                out.push((world_from_target.inv_mul(world_from_source), found));
            }
        }
    }
    out
}

/// Squared errors by their information. Six parameters: 6 on average if it is right.
fn assert_calibrated(noise: Option<SensorNoise>) {
    let found = accepted(noise);
    let squared = found.iter().map(|(truth, found)| {
        let xi = se3::log(&truth.inv_mul(&found.target_from_source));
        (xi.transpose() * found.information * xi)[0]
    });
    let mean = squared.sum::<f64>() / found.len() as f64;
    println!("mean {mean:.2} of {} accepted pairs", found.len());
    assert!(found.len() >= 30, "{} pairs", found.len());
    assert!((3.0..=12.0).contains(&mean), "{mean}");
}

#[test]
fn accepted_motions_are_as_certain_as_they_claim() {
    assert_calibrated(None);
}

#[test]
fn so_they_are_with_a_noisy_sensor() {
    assert_calibrated(Some(SensorNoise::default()));
}

/// Median error of neighbours in time, refined from 2 cm and half a degree beside the truth, metres.
fn refined_error_m(views: &[(Prepared, Pose)], pixels: Vec<PixelScale>) -> f64 {
    let settings = Settings { pixels, ..Settings::default() };
    let beside = se3::exp(&Tangent::new(0.01, -0.015, 0.01, 0.004, 0.006, -0.004));
    let mut errors = Vec::new();
    for pair in views.windows(2) {
        let [(source, world_from_source), (target, world_from_target)] = pair else { unreachable!() };
        let truth = world_from_target.inv_mul(world_from_source);
        if let Ok(found) = refine(source, target, &(truth * beside), &settings) {
            errors.push(se3::distance(&truth, &found.target_from_source).0);
        }
    }
    assert!(errors.len() >= 8, "{}", errors.len());
    errors.sort_by(f64::total_cmp);
    errors[errors.len() / 2]
}

#[test]
fn pixels_meet_where_averages_over_voxels_miss() {
    for (noise, most) in [(None, 0.8), (Some(SensorNoise::default()), 0.5)] {
        let views = views(noise);
        let (voxels_m, pixels_m) =
            (refined_error_m(&views, Vec::new()), refined_error_m(&views, Settings::default().pixels));
        println!("voxels {:.3} mm, pixels {:.3} mm", 1e3 * voxels_m, 1e3 * pixels_m);
        assert!(pixels_m < most * voxels_m, "{voxels_m} and {pixels_m}");
    }
}
