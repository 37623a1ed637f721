//! The public pose graphs: the costs that GTSAM reaches are reached from a chordal start.

mod world;

use coma_pose_graph::g2o::G2oGraph;
use coma_pose_graph::initialise::chordal;
use coma_pose_graph::{Solved, SolverSettings};
use std::time::Instant;
use world::shared_data;

fn optimum(name: &str) -> Solved {
    let path = shared_data().join("pose-graphs").join(name);
    let graph = G2oGraph::parse(&std::fs::read_to_string(path).unwrap()).unwrap();
    let (problem, start) = graph.problem();
    let weights = vec![1.0; problem.constraints.len()];
    let clock = Instant::now();
    let start = chordal(&problem, &start, &weights).unwrap();
    let chordal_ms = clock.elapsed().as_secs_f64() * 1e3;
    let solved = problem.solve(&start, &weights, &SolverSettings::default()).unwrap();
    let total_ms = clock.elapsed().as_secs_f64() * 1e3;
    println!(
        "{name}: chordal {chordal_ms:.0} ms, LM {:.0} ms, {} iterations, cost {} -> {}",
        total_ms - chordal_ms,
        solved.iterations,
        solved.initial_cost,
        solved.cost
    );
    solved
}

fn reaches(name: &str, cost: f64) {
    let solved = optimum(name);
    assert!(solved.converged);
    assert!((solved.cost / cost - 1.0).abs() < 1e-4, "{name}: {} instead of {cost}", solved.cost);
}

#[test]
#[ignore = "needs the shared data folder"]
fn small_grid_reaches_the_known_cost() {
    reaches("smallGrid3D.g2o", 517.925);
}

#[test]
#[ignore = "needs the shared data folder"]
fn parking_garage_reaches_the_known_cost() {
    reaches("parking-garage.g2o", 0.634192);
}

#[test]
#[ignore = "needs the shared data folder"]
fn sphere_reaches_the_known_cost() {
    reaches("sphere2500.g2o", 675.701);
}

#[test]
#[ignore = "needs the shared data folder"]
fn torus_reaches_the_known_cost() {
    reaches("torus3D.g2o", 12117.6);
}
