//! Block by block, over a network that loses and delays, the central optimum is reached.

mod world;

use coma_geometry::Pose;
use coma_pose_graph::SolverSettings;
use coma_pose_graph::blocks::{BlockSettings, Network, Simulation, blocks};
use coma_pose_graph::g2o::{G2oGraph, G2oLimits};
use coma_pose_graph::initialise::chordal;
use world::shared_data;

#[test]
#[ignore = "probe"]
fn probe() {
    let relax: f64 = std::env::var("RELAX").map_or(1.8, |v| v.parse().unwrap());
    let loss: f64 = std::env::var("LOSS").map_or(0.0, |v| v.parse().unwrap());
    let delay: f64 = std::env::var("DELAY").map_or(0.5, |v| v.parse().unwrap());
    let most: u64 = std::env::var("ROUNDS").map_or(500, |v| v.parse().unwrap());
    let sets = std::env::var("SETS").unwrap_or("sphere2500.g2o".into());
    for name in sets.split(',') {
        let path = shared_data().join("pose-graphs").join(name);
        let mut files = vec![path.clone()];
        if path.is_dir() {
            files = std::fs::read_dir(&path).unwrap().map(|f| f.unwrap().path()).collect();
            files.sort();
        }
        let graphs: Vec<G2oGraph> = files
            .iter()
            .map(|f| {
                G2oGraph::parse_part(&std::fs::read_to_string(f).unwrap(), &G2oLimits::default()).unwrap()
            })
            .collect();
        let mut whole = graphs[0].clone();
        for g in &graphs[1..] {
            whole.vertices.extend(g.vertices.iter().map(|(k, v)| (*k, *v)));
            for e in &g.edges {
                if !whole.edges.iter().any(|o| (o.from, o.to) == (e.from, e.to)) {
                    whole.edges.push(e.clone());
                }
            }
        }
        let (problem, start) = whole.problem();
        let weights = vec![1.0; problem.constraints.len()];
        let begin = chordal(&problem, &start, &weights).unwrap();
        let central = problem.solve(&begin, &weights, &SolverSettings::default()).unwrap();
        for count in [5, 50] {
            let clock = std::time::Instant::now();
            let cut = blocks(&problem, &weights, &vec![false; weights.len()], count);
            let settings = BlockSettings { most_momentum: relax, ..BlockSettings::default() };
            let network = Network { loss, repeated: 0.1, delay_rounds: delay, seed: 1 };
            let mut simulation = Simulation::new(cut, |n| start[n as usize], settings, network);
            let mut reached = None;
            let mut line = String::new();
            while simulation.rounds() < most && !simulation.is_settled() {
                simulation.round().unwrap();
                let poses: Option<Vec<Pose>> = simulation.poses(problem.nodes).into_iter().collect();
                if let Some(poses) = poses {
                    let excess = problem.cost(&poses, &weights) / central.cost - 1.0;
                    let r = simulation.rounds();
                    if r.is_power_of_two() || r.is_multiple_of(100) {
                        line += &format!(" {r}:{excess:.1e}");
                    }
                    if excess < 1e-3 && reached.is_none() {
                        reached = Some((r, simulation.traffic));
                        if std::env::var("ON").is_err() {
                            break;
                        }
                    }
                }
            }
            println!(
                "{name} {count} relax {relax} loss {loss} cost {}: {reached:?} settled {} {:?} {:.1} s | {line}",
                central.cost,
                simulation.is_settled(),
                simulation.traffic,
                clock.elapsed().as_secs_f64()
            );
        }
    }
}
