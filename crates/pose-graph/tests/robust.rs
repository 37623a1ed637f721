//! False loops lose, true loops win, and the order of the entries does not matter.

mod world;

use coma_pose_graph::gnc::Kernel;
use coma_pose_graph::{GlobalSettings, LoopVerdict, solve};
use world::{Random, World};

/// Agents with true loops between neighbours and within each, and false ones anywhere.
fn contested(agents: &[&str], seed: u64, false_loops: usize) -> World {
    let mut world = World::new(seed);
    for (k, name) in agents.iter().enumerate() {
        world.walk(name, k as f64, 50);
    }
    for pair in agents.windows(2) {
        for k in 0..8 {
            let (i, j) = (3 + 5 * k, 2 + 5 * k + world.random.below(4) as u32);
            world.measured_loop((pair[0], i), (pair[1], j));
        }
    }
    for name in agents {
        world.measured_loop((name, 0), (name, 49));
    }
    for k in 0..false_loops {
        let a = k % agents.len();
        let b = (a + 1 + world.random.below(agents.len() - 1)) % agents.len();
        // Every fifth false loop lies within one agent.
        let b = if k % 5 == 4 { a } else { b };
        let (i, j) = (world.random.below(25) as u32, 25 + world.random.below(25) as u32);
        world.false_loop((agents[a], i), (agents[b], j));
    }
    world
}

fn survives(agents: &[&str], false_loops: usize, kernel: Kernel) {
    for seed in 0..10 {
        let world = contested(agents, 100 + seed, false_loops);
        let mut settings = GlobalSettings::default();
        settings.robust.kernel = kernel;
        let solution = solve(&world.entries, &settings);
        assert_eq!(solution.components.len(), 1, "seed {seed}");
        let component = &solution.components[0];
        let is_false = |l: &&coma_pose_graph::LoopWeight| world.false_loops.contains(&l.key);
        for l in component.loops.iter().filter(is_false) {
            assert!(l.weight < 0.5 && l.verdict != LoopVerdict::Used, "seed {seed}: {l:?}");
        }
        let (used, all) = component
            .loops
            .iter()
            .filter(|l| !is_false(l))
            .fold((0, 0), |(used, all), l| (used + usize::from(l.weight > 0.5), all + 1));
        assert!(used * 10 >= all * 9, "seed {seed}: {used} of {all} true loops used");
        let (m, rad) = world.worst_error(component);
        assert!(m < 0.4 && rad < 0.15, "seed {seed}: {m} m {rad} rad");
    }
}

#[test]
fn false_loops_between_two_agents_are_rejected() {
    survives(&["a", "b"], 10, Kernel::TruncatedLeastSquares);
}

#[test]
fn false_loops_among_three_agents_are_rejected() {
    survives(&["a", "b", "c"], 20, Kernel::TruncatedLeastSquares);
}

#[test]
fn geman_mcclure_rejects_them_too() {
    survives(&["a", "b", "c"], 10, Kernel::GemanMcClure);
}

#[test]
fn order_and_duplicates_change_no_bit() {
    let world = contested(&["a", "b", "c"], 7, 9);
    let reference = solve(&world.entries, &GlobalSettings::default());
    let mut random = Random(1);
    for _ in 0..20 {
        let mut entries = world.entries.clone();
        for _ in 0..10 {
            let copy = entries.edges[random.below(entries.edges.len())].clone();
            entries.edges.push(copy);
        }
        random.shuffle(&mut entries.edges);
        // Equality of f64 is equality of bits here: nothing is NaN or a signed zero.
        assert_eq!(solve(&entries, &GlobalSettings::default()), reference);
    }
}
