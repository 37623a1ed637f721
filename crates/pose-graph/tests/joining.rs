//! When agents come to share a map, when they do not, and whose frame it has.

mod world;

use coma_geometry::{Epoch, MapId, Pose, se3};
use coma_pose_graph::g2o::G2oGraph;
use coma_pose_graph::graph::{EntryName, EntryProblem};
use coma_pose_graph::relative::NotJoined;
use coma_pose_graph::{EdgeKey, EdgeKind, GlobalSettings, LoopVerdict, solve};
use world::{World, agent, submap};

fn two_agents(seed: u64) -> World {
    let mut world = World::new(seed);
    world.walk("a", 0.0, 30);
    world.walk("b", 1.0, 30);
    world
}

#[test]
fn agents_without_loops_keep_their_own_maps() {
    let world = two_agents(1);
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(solution.components.len(), 2);
    for (component, name) in solution.components.iter().zip(["a", "b"]) {
        assert_eq!(component.gauge, submap(name, 0));
        assert_eq!(component.map_from_submap[&submap(name, 0)], Pose::identity());
        assert_eq!(component.map_from_submap.len(), 30);
        assert_eq!(component.composed.len(), 29);
        let odometric = world.entries.nodes[&submap(name, 29)].agent_from_submap;
        let (m, rad) = se3::distance(&component.map_from_submap[&submap(name, 29)], &odometric);
        assert!(m < 1e-9 && rad < 1e-9);
    }
    assert!(solution.cut.is_empty() && solution.rejected.is_empty());
}

#[test]
fn one_loop_is_not_enough_and_the_reason_says_so() {
    let mut world = two_agents(2);
    let key = world.measured_loop(("a", 5), ("b", 3));
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(solution.components.len(), 2);
    let reason = NotJoined::TooFewLoops { found: 1, needed: 2 };
    assert_eq!(solution.pairs[0].outcome.as_ref().unwrap_err(), &reason);
    assert_eq!(solution.waiting[0].key, key);
    assert_eq!(solution.waiting[0].verdict, LoopVerdict::Waiting(reason));
}

#[test]
fn two_loops_from_one_place_are_not_independent() {
    let mut world = two_agents(3);
    // The agents stood still: the second submap of each is where the first is, 15 frames later.
    for name in ["a", "b"] {
        let place = world.entries.nodes[&submap(name, 9)].clone();
        let next = world.entries.nodes.get_mut(&submap(name, 10)).unwrap();
        next.first_frame = place.first_frame + 15;
        next.agent_from_submap = place.agent_from_submap;
    }
    world.measured_loop(("a", 9), ("b", 9));
    world.measured_loop(("a", 10), ("b", 10));
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(
        solution.pairs[0].outcome.as_ref().unwrap_err(),
        &NotJoined::TooFewIndependentLoops { found: 1, consistent: 2, needed: 2 }
    );
    assert_eq!(solution.components.len(), 2);
}

#[test]
fn two_loops_that_contradict_each_other_do_not_join() {
    let mut world = two_agents(4);
    world.measured_loop(("a", 5), ("b", 3));
    world.false_loop(("a", 20), ("b", 16));
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(
        solution.pairs[0].outcome.as_ref().unwrap_err(),
        &NotJoined::TooFewConsistentLoops { found: 1, total: 2, needed: 2 }
    );
}

#[test]
fn two_independent_loops_join_two_agents() {
    let mut world = two_agents(5);
    world.measured_loop(("a", 5), ("b", 3));
    world.measured_loop(("b", 16), ("a", 20));
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(solution.components.len(), 1);
    let component = &solution.components[0];
    assert!(component.converged && component.failure.is_none());
    assert_eq!(component.map_id.to_string(), "a/0");
    assert_eq!(component.map_from_submap[&submap("a", 0)], Pose::identity());
    assert!(component.loops.iter().all(|l| l.weight == 1.0 && l.verdict == LoopVerdict::Used));
    let (m, rad) = world.worst_error(component);
    assert!(m < 0.5 && rad < 0.1, "{m} m {rad} rad");
    // The relative phase alone comes near too: agents begin at their first submaps.
    let join = solution.pairs[0].outcome.as_ref().unwrap();
    let truth = world.world_from_submap[&submap("a", 0)].inverse() * world.world_from_submap[&submap("b", 0)];
    let (m, rad) = se3::distance(&join.agent_s_from_agent_t, &truth);
    assert!(m < 0.5 && rad < 0.1, "{m} m {rad} rad");
    assert_eq!((join.consistent.len(), join.independent), (2, 2));
}

#[test]
fn the_gauge_is_the_agent_with_the_smallest_priority_then_id() {
    let mut world = two_agents(6);
    world.measured_loop(("a", 5), ("b", 3));
    world.measured_loop(("a", 20), ("b", 16));
    let before = solve(&world.entries, &GlobalSettings::default());
    world.entries.anchor_priority.insert(agent("b"), 7);
    let after = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(after.components[0].gauge, submap("b", 0));
    assert_eq!(after.components[0].map_from_submap[&submap("b", 0)], Pose::identity());
    // The same map in another frame.
    assert!((before.components[0].cost - after.components[0].cost).abs() < 1e-6 * before.components[0].cost);
    let old = before.components[0].map_id.clone();
    let new_map_from_old_map = after.components[0].map_from_old_map(&old).unwrap();
    for (submap, old_pose) in &before.components[0].map_from_submap {
        let carried = new_map_from_old_map * old_pose;
        let (m, rad) = se3::distance(&carried, &after.components[0].map_from_submap[submap]);
        assert!(m < 1e-4 && rad < 1e-4, "{submap}: {m} {rad}");
    }
    assert_eq!(after.components[0].map_from_old_map(&MapId::of(&submap("c", 0))), None);
}

#[test]
fn three_agents_join_along_a_chain() {
    let mut world = two_agents(7);
    world.walk("c", 2.0, 30);
    for k in 0..4 {
        world.measured_loop(("a", 3 + 6 * k), ("b", 2 + 6 * k));
        world.measured_loop(("b", 4 + 6 * k), ("c", 3 + 5 * k));
    }
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(solution.components.len(), 1);
    assert_eq!(solution.components[0].agents.len(), 3);
    let (m, rad) = world.worst_error(&solution.components[0]);
    assert!(m < 0.5 && rad < 0.1, "{m} m {rad} rad");
}

#[test]
fn withdrawing_a_loop_parts_the_agents_again() {
    let mut world = two_agents(8);
    world.measured_loop(("a", 5), ("b", 3));
    let key = world.measured_loop(("a", 20), ("b", 16));
    let joined = solve(&world.entries, &GlobalSettings::default());
    let by = world.key("a");
    world.entries.withdrawn.insert(key.clone(), by.clone());
    let parted = solve(&world.entries, &GlobalSettings::default());
    assert_eq!((joined.components.len(), parted.components.len()), (1, 2));
    assert_eq!(parted.rejected, [(EntryName::Edge(key.clone()), EntryProblem::Withdrawn { by: by.clone() })]);
    assert_eq!(parted.cut[&(agent("a"), Epoch(0))], by.sequence);
    // Nobody else may withdraw it.
    let foreign = world.key("b");
    world.entries.withdrawn.insert(key, foreign);
    assert_eq!(solve(&world.entries, &GlobalSettings::default()).components.len(), 1);
}

#[test]
fn odometry_after_the_cut_is_composed_and_changes_no_name() {
    let mut world = two_agents(9);
    world.measured_loop(("a", 5), ("b", 3));
    world.measured_loop(("b", 16), ("a", 20));
    let before = solve(&world.entries, &GlobalSettings::default());
    world.walk("b", 1.0, 5);
    let after = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(before.generation(&before.components[0]), after.generation(&after.components[0]));
    let composed = &after.components[0].composed;
    assert!((30..35).all(|k| composed.contains(&submap("b", k))));
    for (submap, pose) in &before.components[0].map_from_submap {
        assert_eq!(pose, &after.components[0].map_from_submap[submap]);
    }
    // A new loop moves the cut.
    world.measured_loop(("b", 33), ("a", 25));
    let solved = solve(&world.entries, &GlobalSettings::default());
    assert_ne!(solved.cut, after.cut);
    assert!(!solved.components[0].composed.contains(&submap("b", 33)));
}

#[test]
fn a_chain_that_lost_tracking_rejoins_through_loops() {
    let mut world = two_agents(10);
    let lost = |e: &coma_pose_graph::Edge| e.kind == EdgeKind::Odometry && e.to == submap("a", 15);
    world.entries.edges.retain(|e| !lost(e));
    let apart = solve(&world.entries, &GlobalSettings::default());
    let names: Vec<String> = apart.components.iter().map(|c| c.map_id.to_string()).collect();
    assert_eq!(names, ["a/0", "a/0/s15", "b/0"]);
    world.measured_loop(("a", 18), ("a", 4));
    world.measured_loop(("a", 26), ("a", 10));
    let rejoined = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(rejoined.components.len(), 2);
    assert!(rejoined.components[0].map_from_old_map(&apart.components[1].map_id).is_some());
    let (m, rad) = world.worst_error(&rejoined.components[0]);
    assert!(m < 0.5 && rad < 0.1, "{m} m {rad} rad");
}

#[test]
fn bad_entries_are_named_with_their_problem_and_the_rest_is_used() {
    let mut world = two_agents(11);
    world.measured_loop(("a", 5), ("b", 3));
    world.measured_loop(("a", 20), ("b", 16));
    let good = solve(&world.entries, &GlobalSettings::default());
    let sound = world.entries.edges.last().unwrap().clone();
    let mut bad = |change: &dyn Fn(&mut coma_pose_graph::Edge)| {
        let mut edge = sound.clone();
        edge.from = submap("a", 2);
        edge.to = submap("b", 1);
        edge.key = world.key("z");
        change(&mut edge);
        world.entries.edges.push(edge.clone());
        edge.key
    };
    let keys = [
        bad(&|e| e.from_from_to.translation.vector.x = f64::NAN),
        bad(&|e| e.from_from_to.translation.vector.x = 1e9),
        bad(&|e| {
            e.from_from_to.rotation =
                nalgebra::Unit::new_unchecked(nalgebra::Quaternion::new(2.0, 0.0, 0.0, 0.0))
        }),
        bad(&|e| e.information[(2, 2)] = f64::INFINITY),
        bad(&|e| e.information[(2, 4)] = 30.0),
        bad(&|e| e.information[(3, 3)] = -1.0),
        bad(&|e| e.to = submap("q", 0)),
        bad(&|e| e.to = submap("a", 2)),
        bad(&|e| e.kind = EdgeKind::Odometry),
    ];
    let solution = solve(&world.entries, &GlobalSettings::default());
    let problem = |key: &EdgeKey| {
        let found = solution.rejected.iter().find(|(name, _)| name == &EntryName::Edge(key.clone()));
        found.unwrap_or_else(|| panic!("{key:?} was not rejected")).1.clone()
    };
    assert_eq!(problem(&keys[0]), EntryProblem::PoseNotFinite);
    assert!(matches!(problem(&keys[1]), EntryProblem::TranslationTooLarge { .. }));
    assert_eq!(problem(&keys[2]), EntryProblem::RotationNotUnit { length: 2.0 });
    assert_eq!(problem(&keys[3]), EntryProblem::InformationNotFinite);
    assert_eq!(problem(&keys[4]), EntryProblem::InformationNotSymmetric { row: 4, column: 2 });
    assert!(matches!(problem(&keys[5]), EntryProblem::InformationNotPositiveDefinite { .. }));
    assert_eq!(problem(&keys[6]), EntryProblem::UnknownNode { submap: submap("q", 0) });
    assert_eq!(problem(&keys[7]), EntryProblem::SelfEdge);
    assert!(matches!(problem(&keys[8]), EntryProblem::OdometryBetweenAgents { .. }));
    assert_eq!(solution.digest, good.digest);
}

#[test]
fn of_two_verdicts_on_one_pair_the_smallest_key_counts() {
    let mut world = two_agents(12);
    world.measured_loop(("a", 5), ("b", 3));
    let first = world.measured_loop(("a", 20), ("b", 16));
    let second = world.measured_loop(("b", 16), ("a", 20));
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(
        solution.rejected,
        [(EntryName::Edge(second), EntryProblem::Superseded { by: first.clone() })]
    );
    // Two different entries under one key: neither counts.
    let mut twin = world.entries.edges.iter().find(|e| e.key == first).unwrap().clone();
    twin.from_from_to.translation.vector.x += 0.001;
    world.entries.edges.push(twin);
    let solution = solve(&world.entries, &GlobalSettings::default());
    assert_eq!(solution.rejected, [(EntryName::Edge(first), EntryProblem::ConflictingKey)]);
}

#[test]
fn a_solution_written_as_g2o_has_the_same_cost() {
    let mut world = two_agents(13);
    world.measured_loop(("a", 5), ("b", 3));
    world.measured_loop(("a", 20), ("b", 16));
    world.measured_loop(("a", 28), ("b", 27));
    world.false_loop(("a", 1), ("b", 22));
    let solution = solve(&world.entries, &GlobalSettings::default());
    let (graph, submaps) = G2oGraph::from_solution(&solution, &world.entries);
    assert_eq!((submaps.len(), graph.edges.len()), (60, 58 + 3));
    let (problem, poses) = G2oGraph::parse(&graph.to_text()).unwrap().problem();
    let wanted = solution.components[0].cost;
    // Some odometry lies after the cut: it is composed and costs nothing.
    assert!((problem.cost(&poses, &[1.0; 61]) - wanted).abs() < 1e-6 * wanted);
}
