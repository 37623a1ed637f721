//! Block by block, over a network that loses and delays, the central optimum is reached.

mod world;

use coma_geometry::{Pose, Tangent, se3};
use coma_pose_graph::blocks::coarse::News;
use coma_pose_graph::blocks::field::Field;
use coma_pose_graph::blocks::{BlockAgent, BlockSettings, Boundary, Network, Simulation, blocks};
use coma_pose_graph::g2o::{G2oGraph, G2oLimits};
use coma_pose_graph::gnc::{self, RobustSettings, Trust};
use coma_pose_graph::initialise::chordal;
use coma_pose_graph::{Constraint, Problem, SolverSettings, team};
use std::path::PathBuf;
use world::{Random, information, shared_data};

const SIGMA: (f64, f64) = (0.02, 0.01);
const DENSE_SIGMA: (f64, f64) = (0.01, 0.009);
const CLEAN: Network = Network { loss: 0.0, repeated: 0.0, delay_rounds: 0.0, seed: 1 };
const POOR: Network = Network { loss: 0.3, repeated: 0.1, delay_rounds: 3.0, seed: 1 };

/// A long ladder, and where its nodes are: news needs many steps from one end to the other.
fn ladder(steps: usize, seed: u64) -> (Problem, Vec<Pose>) {
    let mut random = Random(seed);
    let truth: Vec<Pose> = (0..2 * steps)
        .map(|k| {
            let (along, side) = ((k / 2) as f64, (k % 2) as f64);
            se3::exp(&Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.05 * along))
                * Pose::translation(20.0, side, 0.2 * along)
        })
        .collect();
    let mut constraints = Vec::new();
    for from in 0..2 * steps {
        let across = (from % 2 == 0).then_some(from + 1);
        for to in across.into_iter().chain([from + 2]).filter(|to| *to < 2 * steps) {
            let exact = truth[from].inverse() * truth[to];
            let from_from_to = exact * se3::exp(&random.tangent(SIGMA));
            constraints.push(Constraint { from, to, from_from_to, information: information(SIGMA) });
        }
    }
    // The far end is tied to the beginning, so that there is something to bend.
    let exact = truth[0].inverse() * truth[2 * steps - 1];
    let from_from_to = exact * se3::exp(&random.tangent(SIGMA));
    constraints.push(Constraint {
        from: 0,
        to: 2 * steps - 1,
        from_from_to,
        information: information(SIGMA),
    });
    let fixed = (0..2 * steps).map(|k| k == 0).collect();
    (Problem { nodes: 2 * steps, constraints, fixed }, truth)
}

/// Agents that walk at random through one square world, 20 nodes each, with loops between near nodes: nearly every agent
/// meets every other, and what is slow is the bending of the whole world.
fn dense_team(agents: usize, seed: u64) -> (Problem, Vec<Pose>) {
    const WALK: usize = 20;
    let mut random = Random(seed);
    let side_m = (0.63 * (agents * WALK) as f64).sqrt();
    let mut truth: Vec<Pose> = Vec::new();
    for _ in 0..agents {
        let (mut x, mut y) = (random.uniform() * side_m, random.uniform() * side_m);
        let mut yaw = random.uniform() * std::f64::consts::TAU;
        for _ in 0..WALK {
            truth.push(Pose::translation(x, y, 1.5) * se3::exp(&Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, yaw)));
            loop {
                yaw += 1.5 * (random.uniform() - 0.5);
                let (ahead_x, ahead_y) = (x + yaw.cos(), y + yaw.sin());
                if (0.0..=side_m).contains(&ahead_x) && (0.0..=side_m).contains(&ahead_y) {
                    (x, y) = (ahead_x, ahead_y);
                    break;
                }
            }
        }
    }
    let mut constraints = Vec::new();
    for from in 0..truth.len() {
        let near = |to: &usize| to - from > 5 && se3::distance(&truth[from], &truth[*to]).0 < 2.0;
        let near: Vec<usize> = (from + 1..truth.len()).filter(near).collect();
        let next = (from % WALK + 1 < WALK).then_some(from + 1);
        for to in next.into_iter().chain(near.into_iter().step_by(2).take(3)) {
            let from_from_to = truth[from].inv_mul(&truth[to]) * se3::exp(&random.tangent(DENSE_SIGMA));
            constraints.push(Constraint { from, to, from_from_to, information: information(DENSE_SIGMA) });
        }
    }
    let fixed = (0..truth.len()).map(|k| k == 0).collect();
    (Problem { nodes: truth.len(), constraints, fixed }, truth)
}

/// Rounds until the cost is within 0.1 % of `goal`, if it gets there.
fn rounds(
    problem: &Problem,
    start: &[Pose],
    goal: f64,
    count: usize,
    settings: BlockSettings,
    network: Network,
    most: u64,
) -> Option<u64> {
    let weights = vec![1.0; problem.constraints.len()];
    let cut = blocks(problem, &weights, &vec![false; weights.len()], count);
    let mut simulation = Simulation::new(cut, |n| start[n as usize], settings, network);
    while simulation.rounds() < most && !simulation.is_settled() {
        simulation.round().unwrap();
        let poses: Option<Vec<Pose>> = simulation.poses(problem.nodes).into_iter().collect();
        if poses.is_some_and(|poses| problem.cost(&poses, &weights) <= 1.001 * goal) {
            return Some(simulation.rounds());
        }
    }
    None
}

#[test]
fn a_long_row_of_blocks_reaches_the_central_cost_over_a_poor_network() {
    let (problem, truth) = ladder(100, 3);
    let weights = vec![1.0; problem.constraints.len()];
    let goal = problem.solve(&truth, &weights, &SolverSettings::default()).unwrap().cost;
    let with = |settings, network, most| rounds(&problem, &truth, goal, 25, settings, network, most);
    let clean = with(BlockSettings::default(), CLEAN, 400).expect("over a network that loses nothing");
    let poor = with(BlockSettings::default(), POOR, 1500).expect("over a poor network");
    println!("rounds: {clean}, over a poor network {poor}");
    // Without rounds in which all move together the row bends back too slowly.
    let alone = BlockSettings { coarse_every: 0, ..BlockSettings::default() };
    assert_eq!(with(alone, CLEAN, 2 * clean), None);
}

#[test]
fn a_dense_team_reaches_the_central_cost_over_a_poor_network() {
    for seed in 0..3 {
        let (problem, truth) = dense_team(12, seed);
        let weights = vec![1.0; problem.constraints.len()];
        let goal = problem.solve(&truth, &weights, &SolverSettings::default()).unwrap().cost;
        let with = |settings, network, most| rounds(&problem, &truth, goal, 12, settings, network, most);
        let clean = with(BlockSettings::default(), CLEAN, 80).expect("over a network that loses nothing");
        let poor = with(BlockSettings::default(), POOR, 300).expect("over a poor network");
        println!("seed {seed}: {clean} rounds, over a poor network {poor}");
        // Descent alone is slow to bend the world.
        let alone = BlockSettings { coarse_every: 0, ..BlockSettings::default() };
        assert_eq!(with(alone, CLEAN, 3 * clean), None);
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_and_agents_fall_silent() {
    let (problem, truth) = ladder(20, 5);
    let weights = vec![1.0; problem.constraints.len()];
    let run = |seed: u64| {
        let cut = blocks(&problem, &weights, &vec![false; weights.len()], 5);
        let network = Network { seed, ..POOR };
        let mut simulation = Simulation::new(cut, |n| truth[n as usize], BlockSettings::default(), network);
        while !simulation.is_settled() {
            assert!(simulation.rounds() < 20_000, "they go on talking");
            simulation.round().unwrap();
        }
        (simulation.poses(problem.nodes), simulation.traffic)
    };
    assert!(run(1) == run(1));
    assert!(run(1).1 != run(2).1);
}

/// The root of a round goes on, and its neighbour hears nothing of it for longer than anyone waits.
#[test]
fn a_block_that_was_left_behind_by_a_round_follows_once_it_hears_again() {
    let (problem, truth) = ladder(12, 5);
    let weights = vec![1.0; problem.constraints.len()];
    let cut = blocks(&problem, &weights, &vec![false; weights.len()], 2);
    let agents = cut.into_iter().map(|b| BlockAgent::new(b, |n| truth[n as usize], BlockSettings::default()));
    let [mut root, mut below]: [BlockAgent; 2] = agents.collect::<Vec<_>>().try_into().ok().unwrap();
    let (mut lost, mut settled) = (0, false);
    for _ in 0..3000 {
        for (_, message) in root.step().unwrap() {
            if root.coarse_rounds() > below.coarse_rounds() && lost < 300 {
                lost += 1;
            } else {
                below.receive(&message);
            }
        }
        for (_, message) in below.step().unwrap() {
            root.receive(&message);
        }
        settled = root.is_settled() && below.is_settled();
        if settled && lost > 0 {
            break;
        }
    }
    assert!(lost >= 300, "a round was lost, {lost} messages");
    assert!(settled && root.coarse_rounds() == below.coarse_rounds());
}

#[test]
fn false_loops_get_the_weights_that_they_have_centrally() {
    for seed in 0..5 {
        let (mut problem, truth) = ladder(40, 10 + seed);
        let mut random = Random(100 + seed);
        let measured = problem.constraints.len();
        for _ in 0..25 {
            let (from, to) = (random.below(80), random.below(80));
            if from == to {
                continue;
            }
            let exact = truth[from].inverse() * truth[to];
            let is_false = problem.constraints.len().is_multiple_of(3);
            let from_from_to =
                if is_false { random.any_pose(20.0) } else { exact * se3::exp(&random.tangent(SIGMA)) };
            problem.constraints.push(Constraint { from, to, from_from_to, information: information(SIGMA) });
        }
        let trust: Vec<Trust> = (0..problem.constraints.len())
            .map(|k| if k < measured { Trust::Full } else { Trust::Doubted })
            .collect();
        let doubted: Vec<bool> = trust.iter().map(|t| *t == Trust::Doubted).collect();
        let central =
            gnc::solve(&problem, &truth, &trust, &RobustSettings::default(), &SolverSettings::default())
                .unwrap();
        // What is in doubt waits until every block has found its place by what is not.
        let weights: Vec<f64> = doubted.iter().map(|d| if *d { 0.0 } else { 1.0 }).collect();
        let cut = blocks(&problem, &weights, &doubted, 8);
        let mut simulation = Simulation::new(cut, |n| truth[n as usize], BlockSettings::default(), POOR);
        while simulation.rounds() < 5000 && !simulation.is_settled() {
            simulation.round().unwrap();
        }
        assert_eq!(simulation.weights(&weights), central.weights, "seed {seed}");
        let poses: Vec<Pose> = simulation.poses(80).into_iter().map(Option::unwrap).collect();
        let cost = problem.cost(&poses, &central.weights);
        assert!(cost <= 1.001 * central.solved.cost, "seed {seed}: {cost} {}", central.solved.cost);
    }
}

#[test]
fn strange_messages_change_nothing() {
    let (problem, truth) = ladder(10, 7);
    let weights = vec![1.0; problem.constraints.len()];
    let cut = blocks(&problem, &weights, &vec![false; weights.len()], 2);
    let new = || BlockAgent::new(cut[0].clone(), |n| truth[n as usize], BlockSettings::default());
    let mut agent = new();
    let mut other = new();
    let mut nan = Pose::identity();
    nan.translation.vector.x = f64::NAN;
    // Of points that the grid does not have.
    let field = Field { motions: vec![Tangent::repeat(9.0); 3], ..Field::default() };
    let message = Boundary {
        from: 1,
        sequence: u64::MAX,
        heard: u64::MAX,
        poses: vec![(10, nan), (0, Pose::translation(9.0, 0.0, 0.0)), (777, Pose::identity())],
        weights: vec![(0, -1.0), (u32::MAX, 0.5)],
        coarse: News {
            edition: u64::MAX,
            begun: true,
            heard: u64::MAX,
            field: Some(field),
            ..News::default()
        },
    };
    agent.receive(&Boundary { from: 9, ..message.clone() });
    agent.receive(&message);
    // From a round that cannot be.
    let coarse = News { round: 5, ..message.coarse.clone() };
    agent.receive(&Boundary { coarse, poses: vec![(10, Pose::identity())], ..message.clone() });
    let coarse = News { round: 1, ..message.coarse.clone() };
    agent.receive(&Boundary { coarse, poses: vec![(10, Pose::identity())], ..message });
    agent.step().unwrap();
    other.step().unwrap();
    assert_eq!(agent.poses(), other.poses());
}

fn whole(name: &str) -> (Problem, Vec<Pose>) {
    let path = shared_data().join("pose-graphs").join(name);
    let mut files: Vec<PathBuf> = vec![path.clone()];
    if path.is_dir() {
        files = std::fs::read_dir(&path).unwrap().map(|f| f.unwrap().path()).collect();
        files.sort();
    }
    let read = |f: &PathBuf| {
        G2oGraph::parse_part(&std::fs::read_to_string(f).unwrap(), &G2oLimits::default()).unwrap()
    };
    team::merged(&files.iter().map(read).collect::<Vec<_>>()).unwrap().problem()
}

#[test]
#[ignore = "needs the shared data folder"]
fn the_public_sets_reach_the_central_cost_in_5_and_50_blocks() {
    for name in ["four-robots", "nine-robots", "sphere2500.g2o"] {
        let (problem, given) = whole(name);
        let weights = vec![1.0; problem.constraints.len()];
        let start = chordal(&problem, &given, &weights).unwrap();
        let goal = problem.solve(&start, &weights, &SolverSettings::default()).unwrap().cost;
        for count in [5, 50] {
            for network in [CLEAN, POOR] {
                let taken = rounds(&problem, &given, goal, count, BlockSettings::default(), network, 5000);
                println!("{name} in {count} blocks, loss {}: {taken:?} rounds", network.loss);
                assert!(taken.is_some(), "{name} in {count} blocks, {network:?}");
            }
        }
    }
}
