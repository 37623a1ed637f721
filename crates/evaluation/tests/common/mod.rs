//! Trajectories with a known truth.

use coma_evaluation::Track;
use coma_geometry::{AgentId, Pose, StampNs, Tangent, se3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub type Posed = (StampNs, Pose);

pub fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

/// -1 to 1.
pub fn uniform(random: &mut ChaCha8Rng) -> f64 {
    f64::from(random.next_u32()) / f64::from(u32::MAX) * 2.0 - 1.0
}

/// A walk through a room of some metres, the camera about level; every agent's is another.
pub fn walk(agent: u32, frames: usize, period_ns: i64) -> Vec<Posed> {
    let a = f64::from(agent);
    let level = se3::exp(&Tangent::new(0.0, 0.0, 0.0, -std::f64::consts::FRAC_PI_2, 0.0, 0.0));
    (0..frames)
        .map(|i| {
            let t = i as f64 * period_ns as f64 * 1e-9;
            let place = Pose::translation(
                (2.6 - 0.5 * a) * (0.42 * t + 2.1 * a).cos() + 0.5 * a,
                (1.7 + 0.3 * a) * (0.42 * t + 2.1 * a).sin() * (0.21 * t).cos() - 0.4 * a,
                1.4 + 0.15 * (1.3 * t + a).sin(),
            );
            let turn = se3::exp(&Tangent::new(
                0.0,
                0.0,
                0.0,
                0.08 * (0.9 * t).sin(),
                0.04 * (1.7 * t).cos(),
                0.42 * t,
            ));
            // Stamps begin somewhere, each agent's elsewhere.
            (
                StampNs(1_700_000_000_123_456_789 * i64::from(agent) + i as i64 * period_ns),
                place * turn * level,
            )
        })
        .collect()
}

/// The walk as seen in another frame of reference, with noise and drift.
pub fn estimated(truth: &[Posed], map_from_world: Pose, noise_m: f64, seed: u64) -> Vec<Posed> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut drift = Pose::identity();
    let mut out = Vec::new();
    for (stamp, world_from_camera) in truth {
        let mut step = || Tangent::from_fn(|_, _| uniform(&mut random)) * noise_m;
        let (wander, jitter) = (step() * 0.15, step() * 0.5);
        drift *= se3::exp(&wander);
        out.push((*stamp, map_from_world * drift * world_from_camera * se3::exp(&jitter)));
    }
    out
}

/// A track of a walk in component `map-0`.
pub fn track(name: &str, truth: Vec<Posed>, estimate: Vec<Posed>) -> Track {
    Track { agent: agent(name), component: "map-0".into(), frames_seen: truth.len(), estimate, truth }
}

/// An arbitrary motion.
pub fn elsewhere() -> Pose {
    se3::exp(&Tangent::new(3.0, -1.0, 0.7, 0.5, -1.1, 2.0))
}
