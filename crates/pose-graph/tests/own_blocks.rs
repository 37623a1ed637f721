//! Blocks that agents make of their own log entries reach what one solve of all entries reaches.

mod world;

use coma_geometry::{AgentId, Pose, SubmapId, se3};
use coma_pose_graph::blocks::own::NoBlock;
use coma_pose_graph::blocks::{BlockAgent, BlockSettings, Boundary, OwnBlock};
use coma_pose_graph::gnc::Trust;
use coma_pose_graph::{EdgeKey, EdgeKind, GlobalSettings, GraphEntries, solve};
use std::collections::BTreeMap;
use world::{World, agent, submap};

const NAMES: [&str; 3] = ["a", "b", "c"];

/// Three agents on circles that overlap, with loops between a and b, and b and c; 4 of 24 are false.
fn team(seed: u64) -> World {
    let mut world = World::new(seed);
    for (k, name) in NAMES.iter().enumerate() {
        world.walk(name, 0.3 * k as f64, 24);
    }
    for n in 0..10 {
        world.measured_loop(("a", 2 * n), ("b", 2 * n + 1));
        world.measured_loop(("c", 2 * n + 1), ("b", 2 * n + 4));
    }
    for n in 0..2 {
        world.false_loop(("a", 7 + 9 * n), ("b", 20 - 5 * n));
        world.false_loop(("b", 9 + 9 * n), ("c", 22 - 5 * n));
    }
    world.measured_loop(("b", 2), ("b", 21));
    // True loops are better than they claim: none is in doubt at the end.
    for edge in world.entries.edges.iter_mut().filter(|e| e.kind == EdgeKind::Loop) {
        let truth = world.world_from_submap[&edge.from].inv_mul(&world.world_from_submap[&edge.to]);
        if !world.false_loops.contains(&edge.key) {
            let error = se3::log(&truth.inv_mul(&edge.from_from_to));
            edge.from_from_to = truth * se3::exp(&(error * 0.5));
        }
    }
    world
}

/// What an agent needs of the entries: its own, and those of whom it has loops with.
fn known_to(entries: &GraphEntries, agents: &[&str]) -> GraphEntries {
    let known = |s: &SubmapId| agents.contains(&s.agent.as_str());
    let mut part = entries.clone();
    part.nodes.retain(|id, _| known(id));
    part.edges.retain(|e| known(&e.from) || known(&e.to));
    part
}

fn own(world: &World, name: &str, knows: &[&str]) -> OwnBlock {
    let team: Vec<AgentId> = NAMES.iter().map(|n| agent(n)).collect();
    let entries = known_to(&world.entries, knows);
    OwnBlock::new(&entries, &agent(name), &team, &submap("a", 0), &GlobalSettings::default()).unwrap()
}

/// Carries a message between two agents, whose numbers of nodes and loops are their own.
fn carried(message: &Boundary, from: &OwnBlock, to: &OwnBlock) -> Boundary {
    let node = |n: u32| to.submaps.binary_search(&from.submaps[n as usize]).ok().map(|k| k as u32);
    let edge = |n: u32| {
        let key = &from.edges[n as usize].key;
        to.edges.iter().position(|e| e.key == *key).map(|k| k as u32)
    };
    Boundary {
        poses: message.poses.iter().filter_map(|(n, pose)| Some((node(*n)?, *pose))).collect(),
        weights: message.weights.iter().filter_map(|(n, weight)| Some((edge(*n)?, *weight))).collect(),
        ..message.clone()
    }
}

fn run(blocks: &[OwnBlock], agents: &mut [BlockAgent], lost: impl Fn(usize) -> bool) -> usize {
    let mut sent = 0;
    for round in 0..5000 {
        for k in 0..agents.len() {
            for (to, message) in agents[k].step().unwrap() {
                sent += 1;
                if !lost(sent) {
                    let to = to as usize;
                    agents[to].receive(&carried(&message, &blocks[k], &blocks[to]));
                }
            }
        }
        if agents.iter().all(BlockAgent::is_still) {
            return round;
        }
    }
    panic!("they are never still");
}

fn assert_agrees(world: &World, blocks: &[OwnBlock], agents: &[BlockAgent]) {
    let central = solve(&world.entries, &GlobalSettings::default());
    let [component] = &central.components[..] else { panic!("{} components", central.components.len()) };
    let mut weights: BTreeMap<EdgeKey, f64> = BTreeMap::new();
    let mut poses: BTreeMap<SubmapId, Pose> = BTreeMap::new();
    for (block, agent) in blocks.iter().zip(agents) {
        for (index, weight) in agent.weights() {
            let squared = agent.squared_error_of(index).unwrap();
            if let Some(l) = block.loop_weight(index, weight, squared) {
                weights.insert(l.key, l.weight);
            }
        }
        poses.extend(block.poses(agent.poses()));
    }
    let of_central: BTreeMap<EdgeKey, f64> =
        component.loops.iter().map(|l| (l.key.clone(), l.weight)).collect();
    assert_eq!(weights, of_central);
    let cost: f64 = agents.iter().map(BlockAgent::cost).sum();
    assert!((cost / component.cost - 1.0).abs() < 1e-3, "{cost}, central {}", component.cost);
    assert!(world.false_loops.iter().all(|key| weights[key] == 0.0));
    assert_eq!(poses.len(), component.map_from_submap.len());
    for (submap, pose) in &poses {
        let (m, rad) = se3::distance(pose, &component.map_from_submap[submap]);
        assert!(m < 2e-3 && rad < 1e-3, "{submap}: {m} m, {rad} rad");
    }
}

fn blocks_of(world: &World) -> Vec<OwnBlock> {
    vec![own(world, "a", &["a", "b"]), own(world, "b", &["a", "b", "c"]), own(world, "c", &["b", "c"])]
}

fn agents_of(blocks: &[OwnBlock]) -> Vec<BlockAgent> {
    let begin =
        |b: &OwnBlock| BlockAgent::new(b.block.clone(), |_| Pose::identity(), BlockSettings::default());
    blocks.iter().map(begin).collect()
}

#[test]
fn blocks_from_log_entries_reach_the_central_cost_and_weights_and_both_ends_trust_alike() {
    for seed in 0..3 {
        let world = team(seed);
        let blocks = blocks_of(&world);
        // No agent knows what it does not need.
        assert!(blocks[0].submaps.iter().all(|s| s.agent.as_str() != "c"));
        let mut trust: BTreeMap<EdgeKey, Trust> = BTreeMap::new();
        for block in &blocks {
            for edge in &block.block.edges {
                let key = block.edges[edge.index as usize].key.clone();
                assert_eq!(*trust.entry(key).or_insert(edge.trust), edge.trust);
            }
        }
        let suspended = trust.values().filter(|t| **t == Trust::Suspended).count();
        assert!(suspended >= 4, "{suspended} loops are suspended");
        let mut agents = agents_of(&blocks);
        let rounds = run(&blocks, &mut agents, |_| false);
        println!("seed {seed}: {rounds} rounds");
        assert_agrees(&world, &blocks, &agents);
        let mut agents = agents_of(&blocks);
        run(&blocks, &mut agents, |n| n % 3 == 0);
        assert_agrees(&world, &blocks, &agents);
    }
}

#[test]
fn one_that_lost_everything_finds_its_place_again() {
    let world = team(1);
    let blocks = blocks_of(&world);
    let mut agents = agents_of(&blocks);
    run(&blocks, &mut agents, |_| false);
    assert_agrees(&world, &blocks, &agents);
    // The middle one begins from nothing; the others keep where they are and tell it again.
    agents[1] = BlockAgent::new(blocks[1].block.clone(), |_| Pose::identity(), BlockSettings::default());
    agents[0].begin_anew();
    agents[2].begin_anew();
    run(&blocks, &mut agents, |_| false);
    assert_agrees(&world, &blocks, &agents);
}

#[test]
fn an_agent_without_a_block_is_told_why() {
    let world = team(1);
    let team: Vec<AgentId> = ["a", "c"].map(agent).to_vec();
    let refused = |name: &str, team: &[AgentId], gauge: &SubmapId| {
        OwnBlock::new(&world.entries, &agent(name), team, gauge, &GlobalSettings::default()).unwrap_err()
    };
    assert_eq!(refused("a", &team, &submap("a", 0)), NoBlock::Alone { agent: agent("a") });
    assert_eq!(refused("d", &[agent("d")], &submap("a", 0)), NoBlock::NoSubmaps { agent: agent("d") });
    let gauge = submap("a", 99);
    assert_eq!(refused("a", &team, &gauge), NoBlock::NoGauge { gauge });
}
