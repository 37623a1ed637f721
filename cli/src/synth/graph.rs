//! `coma synth graph`: a team's pose graph without pictures: random walks in one square world, loops between near poses.

use anyhow::{Context, ensure};
use clap::Args;
use coma_geometry::{Matrix6, Pose, Tangent, se3};
use coma_pose_graph::g2o::{G2oEdge, G2oGraph};
use coma_pose_graph::team::information_of;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Writes a g2o file: the pose graph of a team that walks at random through one square world.
///
/// The world grows with the team, so that a place is visited as often whatever the team's size. Vertices hold the poses
/// by odometry alone, each robot from its true start; vertex ids are GTSAM's symbols.
#[derive(Args)]
pub struct Arguments {
    /// The file.
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    team: Team,
}

/// The team and its world.
#[derive(Args, Clone, Debug)]
pub struct Team {
    /// Robots, 1 to 255.
    #[arg(long, default_value_t = 200)]
    pub agents: usize,
    /// Submaps of each.
    #[arg(long, default_value_t = 100)]
    pub submaps: usize,
    /// Loops for each submap.
    #[arg(long, default_value_t = 3)]
    pub loops: usize,
    /// Standard deviation of a measurement's translation, metres.
    #[arg(long, default_value_t = 0.01)]
    pub sigma_m: f64,
    /// Standard deviation of its rotation, degrees.
    #[arg(long, default_value_t = 0.5)]
    pub sigma_deg: f64,
    /// Walks, loops, noise.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// Length of a submap, metres.
const STEP_M: f64 = 1.0;
/// Poses nearer than this may have a loop.
const NEAR_M: f64 = 2.0;
/// Area of the world for each submap: about 20 others are near.
const AREA_M2: f64 = std::f64::consts::PI * NEAR_M * NEAR_M / 20.0;

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let graph = graph(&arguments.team)?;
    std::fs::write(&arguments.out, graph.to_text()).with_context(|| arguments.out.display().to_string())?;
    println!(
        "{}: {} submaps, {} measurements",
        arguments.out.display(),
        graph.vertices.len(),
        graph.edges.len()
    );
    Ok(())
}

/// The graph; the same settings give the same one.
pub fn graph(team: &Team) -> anyhow::Result<G2oGraph> {
    ensure!((1..=255).contains(&team.agents), "--agents is {}: 1 to 255 is allowed", team.agents);
    ensure!((2..=100_000).contains(&team.submaps), "--submaps is {}: 2 to 100000 is allowed", team.submaps);
    let sigma_rad = team.sigma_deg.to_radians();
    ensure!(team.sigma_m > 0.0 && sigma_rad > 0.0, "--sigma-m and --sigma-deg must be positive");
    let mut random = ChaCha8Rng::seed_from_u64(team.seed);
    let side_m = (AREA_M2 * (team.agents * team.submaps) as f64).sqrt();
    let information = information_of(team.sigma_m, sigma_rad);
    let mut graph = G2oGraph::default();
    let mut truth: BTreeMap<u64, Pose> = BTreeMap::new();
    for agent in 0..team.agents {
        let first = (agent as u64 + 1) << 56;
        let mut here = start(&mut random, side_m);
        let mut guess = here;
        for number in 0..team.submaps as u64 {
            if number > 0 {
                let next = walked(&mut random, &here, side_m);
                let measured = noisy(&mut random, here.inv_mul(&next), team.sigma_m, sigma_rad);
                graph.edges.push(edge(first + number - 1, first + number, measured, information));
                (here, guess) = (next, guess * measured);
            }
            truth.insert(first + number, here);
            graph.vertices.insert(first + number, guess);
        }
    }
    for (from, to) in loops(&mut random, &truth, team.loops) {
        let measured = noisy(&mut random, truth[&from].inv_mul(&truth[&to]), team.sigma_m, sigma_rad);
        graph.edges.push(edge(from, to, measured, information));
    }
    Ok(graph)
}

fn edge(from: u64, to: u64, from_from_to: Pose, information: Matrix6) -> G2oEdge {
    G2oEdge { from, to, from_from_to, information }
}

fn start(random: &mut ChaCha8Rng, side_m: f64) -> Pose {
    let place = Vector3::new(random.random::<f64>() * side_m, random.random::<f64>() * side_m, 1.5);
    facing(place, random.random::<f64>() * std::f64::consts::TAU, random)
}

/// Upright within a few degrees.
fn facing(place: Vector3<f64>, yaw_rad: f64, random: &mut ChaCha8Rng) -> Pose {
    let lean = |random: &mut ChaCha8Rng| (random.random::<f64>() - 0.5) * 0.1;
    let (roll, pitch) = (lean(random), lean(random));
    Pose::from_parts(Translation3::from(place), UnitQuaternion::from_euler_angles(roll, pitch, yaw_rad))
}

/// One step on, turned by up to 45 degrees, and back from the walls.
fn walked(random: &mut ChaCha8Rng, here: &Pose, side_m: f64) -> Pose {
    let (_, _, mut yaw_rad) = here.rotation.euler_angles();
    loop {
        yaw_rad += (random.random::<f64>() - 0.5) * std::f64::consts::FRAC_PI_2;
        let ahead = Vector3::new(yaw_rad.cos(), yaw_rad.sin(), 0.0) * STEP_M;
        let mut place = here.translation.vector + ahead;
        place.z = 1.5 + 0.2 * (random.random::<f64>() - 0.5);
        if (0.0..=side_m).contains(&place.x) && (0.0..=side_m).contains(&place.y) {
            return facing(place, yaw_rad, random);
        }
    }
}

fn noisy(random: &mut ChaCha8Rng, exact: Pose, sigma_m: f64, sigma_rad: f64) -> Pose {
    exact * se3::exp(&Tangent::from_fn(|k, _| normal(random) * if k < 3 { sigma_m } else { sigma_rad }))
}

/// Box and Muller.
fn normal(random: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
}

/// Pairs of near submaps that odometry does not join, each once: up to so many begun by each submap.
fn loops(random: &mut ChaCha8Rng, truth: &BTreeMap<u64, Pose>, for_each: usize) -> BTreeSet<(u64, u64)> {
    let cell = |pose: &Pose| {
        let t = pose.translation.vector / NEAR_M;
        (t.x.floor() as i64, t.y.floor() as i64)
    };
    let mut cells: BTreeMap<(i64, i64), Vec<u64>> = BTreeMap::new();
    for (id, pose) in truth {
        cells.entry(cell(pose)).or_default().push(*id);
    }
    let mut pairs = BTreeSet::new();
    for (id, pose) in truth {
        let (x, y) = cell(pose);
        let around = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (x + dx, y + dy)));
        let mut near: Vec<u64> = around
            .filter_map(|c| cells.get(&c))
            .flatten()
            .filter(|other| id.abs_diff(**other) > 5 && se3::distance(pose, &truth[*other]).0 < NEAR_M)
            .copied()
            .collect();
        let mut begun = 0;
        while begun < for_each && !near.is_empty() {
            let other = near.swap_remove(random.random_range(0..near.len()));
            begun += usize::from(pairs.insert((*id.min(&other), *id.max(&other))));
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    fn team(agents: usize, seed: u64) -> Team {
        Team { agents, submaps: 40, loops: 3, sigma_m: 0.01, sigma_deg: 0.5, seed }
    }

    #[test]
    fn a_graph_has_its_submaps_odometry_and_nearly_all_its_loops() {
        let graph = graph(&team(12, 4)).unwrap();
        assert_eq!(graph.vertices.len(), 480);
        let odometry = graph.edges.iter().filter(|e| e.to == e.from + 1).count();
        assert_eq!(odometry, 12 * 39);
        let loops = graph.edges.len() - odometry;
        assert!((1300..=1440).contains(&loops), "{loops}");
        assert!(graph.edges.iter().all(|e| e.from_from_to.translation.vector.norm() < NEAR_M + 0.1));
        graph.check().unwrap();
    }

    #[test]
    fn the_seed_decides() {
        let text = |seed| graph(&team(3, seed)).unwrap().to_text();
        assert!(text(1) == text(1) && text(1) != text(2));
    }

    #[test]
    fn too_large_a_team_is_refused_by_name() {
        assert!(graph(&team(256, 1)).unwrap_err().to_string().contains("--agents is 256"));
    }
}
