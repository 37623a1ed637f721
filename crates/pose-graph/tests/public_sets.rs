//! The public pose graphs: the costs that GTSAM reaches are reached from a chordal start.

mod world;

use coma_geometry::Pose;
use coma_pose_graph::certified::{self, Start, attempt};
use coma_pose_graph::g2o::G2oGraph;
use coma_pose_graph::initialise::chordal;
use coma_pose_graph::{Problem, Solved, SolverSettings};
use std::time::Instant;
use world::shared_data;

fn read(name: &str) -> (Problem, Vec<Pose>) {
    let path = shared_data().join("pose-graphs").join(name);
    G2oGraph::parse(&std::fs::read_to_string(path).unwrap()).unwrap().problem()
}

fn optimum(name: &str) -> Solved {
    let (problem, start) = read(name);
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

/// SE-Sync's objective and certificate from a chordal start.
fn is_certified(name: &str, objective: f64) {
    let (problem, start) = read(name);
    let weights = vec![1.0; problem.constraints.len()];
    let start = chordal(&problem, &start, &weights).unwrap();
    let end = attempt(&problem, Start::Chordal, &start, &weights, &SolverSettings::default()).unwrap();
    println!(
        "{name}: {} in {} iterations, {:?}",
        end.isotropic.cost, end.isotropic.iterations, end.certificate
    );
    assert!((end.isotropic.cost / objective - 1.0).abs() < 1e-4, "{}", end.isotropic.cost);
    assert!((end.certificate.objective / objective - 1.0).abs() < 1e-4);
    assert!(end.certificate.holds(), "{:?}", end.certificate);
}

#[test]
#[ignore = "needs the shared data folder"]
fn minima_of_the_isotropic_objective_are_certified() {
    is_certified("smallGrid3D.g2o", 1025.40);
    is_certified("parking-garage.g2o", 1.26253);
    is_certified("sphere2500.g2o", 1687.006);
    is_certified("torus3D.g2o", 24227.09);
}

#[test]
#[ignore = "needs the shared data folder"]
fn the_torus_from_its_own_vertices_is_refused_and_solved_from_another_start() {
    let (problem, start) = read("torus3D.g2o");
    let weights = vec![1.0; problem.constraints.len()];
    let attempts = certified::solve(&problem, &start, &weights, &SolverSettings::default()).unwrap();
    for a in &attempts {
        println!(
            "{:?}: cost {}, isotropic {}, {:?}",
            a.start, a.solved.cost, a.isotropic.cost, a.certificate
        );
    }
    let [first, second] = &attempts[..] else { panic!("one attempt was enough") };
    assert!(!first.certificate.holds() && first.isotropic.cost > 1.1 * 24227.09);
    assert!(first.certificate.stationarity < 1e-3, "a local minimum: {:?}", first.certificate);
    assert!(first.certificate.smallest < -1e-4 * first.certificate.largest, "{:?}", first.certificate);
    assert!(second.certificate.holds());
    assert!((second.solved.cost / 12117.6 - 1.0).abs() < 1e-4);
}
