//! Previews follow the cold solve closely, and within the time that a live view has.

mod world;

use coma_geometry::se3;
use coma_pose_graph::preview::{Added, Preview};
use coma_pose_graph::{GlobalSettings, GraphEntries, solve};
use std::time::{SystemTime, UNIX_EPOCH};
use world::World;

/// Four agents of 250 submaps that have met often.
fn thousand() -> World {
    let mut world = World::new(21);
    let names = ["a", "b", "c", "d"];
    for (k, name) in names.iter().enumerate() {
        world.walk(name, k as f64, 250);
    }
    for k in 0..60 {
        let (a, b) = (names[k % 4], names[(k + 1 + k % 3) % 4]);
        if a != b {
            let (i, j) = (world.random.below(250) as u32, world.random.below(250) as u32);
            world.measured_loop((a, i), (b, j));
        }
        world.measured_loop((a, (k as u32 * 4) % 190), (a, (k as u32 * 4) % 190 + 50));
    }
    world
}

/// What this thread has had of the processor; by the clock where the system does not tell. Others may be at work.
fn processor_ms() -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let told = told.and_then(|text| text.split_whitespace().next()?.parse::<u64>().ok());
    let now = || SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64;
    told.unwrap_or_else(now) as f64 * 1e-6
}

fn without_last(entries: &GraphEntries) -> GraphEntries {
    let mut before = entries.clone();
    before.edges.pop();
    before
}

#[test]
fn a_preview_with_a_new_loop_is_the_cold_solve_s_map() {
    let mut world = thousand();
    world.measured_loop(("a", 200), ("d", 30));
    let settings = GlobalSettings::default();
    let before = without_last(&world.entries);
    let published = solve(&before, &settings);
    assert_eq!(published.components.len(), 1);
    let mut preview = Preview::new(&published.components[0], &before, &settings);
    let times: Vec<f64> = (0..5)
        .map(|_| {
            let mut again = preview.clone();
            let begin_ms = processor_ms();
            again.add(world.entries.edges.last().unwrap()).unwrap();
            processor_ms() - begin_ms
        })
        .collect();
    let added = preview.add(world.entries.edges.last().unwrap()).unwrap();
    println!("{} submaps, a new loop: {times:.1?} ms, {added:?}", preview.map_from_submap().len());
    assert!(matches!(added, Added::Solved { weight: 1.0, .. }), "{added:?}");
    let fastest = times.iter().copied().fold(f64::INFINITY, f64::min);
    assert!(fastest < 30.0, "{times:?} ms");
    let cold = solve(&world.entries, &settings);
    let found = preview.map_from_submap();
    for (submap, pose) in &cold.components[0].map_from_submap {
        let (m, rad) = se3::distance(pose, &found[submap]);
        assert!(m < 1e-3 && rad < 1e-4, "{submap}: {m} m {rad} rad");
    }
}

#[test]
fn a_preview_composes_odometry_and_gives_a_false_loop_no_weight() {
    let mut world = thousand();
    let settings = GlobalSettings::default();
    let published = solve(&world.entries, &settings);
    let mut preview = Preview::new(&published.components[0], &world.entries, &settings);
    let before = preview.map_from_submap();
    world.walk("b", 1.0, 1);
    assert_eq!(preview.add(world.entries.edges.last().unwrap()).unwrap(), Added::Composed);
    assert_eq!(preview.map_from_submap().len(), before.len() + 1);
    world.false_loop(("a", 3), ("c", 100));
    let added = preview.add(world.entries.edges.last().unwrap()).unwrap();
    assert!(matches!(added, Added::Solved { weight: 0.0, moved_m: 0.0, .. }), "{added:?}");
    for (submap, pose) in before {
        assert_eq!(preview.map_from_submap()[&submap], pose);
    }
    let mut foreign = world.entries.edges.last().unwrap().clone();
    foreign.to = world::submap("z", 0);
    assert_eq!(preview.add(&foreign).unwrap(), Added::Elsewhere);
}
