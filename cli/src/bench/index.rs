//! `coma bench index`: how long it takes to find the most similar of many descriptors.

use super::cpu::{median, timed};
use clap::Args;
use coma_place::{Descriptor, ExactIndex, Index, Space};
use serde::Serialize;
use std::time::Instant;

/// Fills an index with the places of random walks, and looks places up.
///
/// Real descriptors come in walks: a camera sees much the same from frame to frame. Each walk starts anywhere on the
/// sphere and takes 100 small steps.
#[derive(Args)]
pub struct Arguments {
    /// Numbers of keyframes.
    #[arg(long, value_delimiter = ',', default_value = "1000,10000,100000")]
    keyframes: Vec<usize>,
    /// Values of a descriptor, 1 to 512.
    #[arg(long, default_value_t = 384)]
    dimension: usize,
    /// Queries that are timed.
    #[arg(long, default_value_t = 200)]
    queries: usize,
    /// Neighbours that are asked for.
    #[arg(long, default_value_t = 20)]
    nearest: usize,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row {
    keyframes: usize,
    build_ms: f64,
    query_ms: f64,
    query_cpu_ms: f64,
}

/// Steps of a walk.
const STEPS: usize = 100;
/// Length of a step against the unit vector's.
const STEP: f32 = 0.1;

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut rows = Vec::new();
    for &keyframes in &arguments.keyframes {
        let places = walks(keyframes + arguments.queries.max(1), arguments.dimension)?;
        let (known, asked) = places.split_at(keyframes);
        let mut index = ExactIndex::default();
        let begin = Instant::now();
        known.iter().enumerate().for_each(|(key, descriptor)| index.insert(key, descriptor));
        let build_ms = begin.elapsed().as_secs_f64() * 1e3;
        let (mut wall_ms, mut cpu_ms) = (Vec::new(), Vec::new());
        for query in asked {
            let begin = Instant::now();
            let (hits, ms) = timed(|| index.query(query, arguments.nearest, &|_| true));
            wall_ms.push(begin.elapsed().as_secs_f64() * 1e3);
            cpu_ms.push(ms);
            anyhow::ensure!(hits.len() == arguments.nearest.min(keyframes), "the index lost descriptors");
        }
        rows.push(Row { keyframes, build_ms, query_ms: median(wall_ms), query_cpu_ms: median(cpu_ms) });
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
        return Ok(());
    }
    println!("| keyframes | build ms | query ms, median | query CPU ms |\n|---|---|---|---|");
    for r in &rows {
        println!("| {} | {:.0} | {:.3} | {:.3} |", r.keyframes, r.build_ms, r.query_ms, r.query_cpu_ms);
    }
    Ok(())
}

/// Descriptors along random walks on the sphere; the same ones every time.
fn walks(count: usize, dimension: usize) -> anyhow::Result<Vec<Descriptor>> {
    let space = Space::new("walks/1")?;
    let mut random = Normal { state: 1 };
    let mut at = vec![0.0f32; dimension];
    let mut out = Vec::with_capacity(count);
    for k in 0..count {
        let scale = if k % STEPS == 0 { 1.0 } else { STEP } / (dimension as f32).sqrt();
        if k % STEPS == 0 {
            at.fill(0.0);
        }
        at.iter_mut().for_each(|v| *v += scale * random.next());
        let norm = at.iter().map(|v| v * v).sum::<f32>().sqrt();
        at.iter_mut().for_each(|v| *v /= norm);
        out.push(Descriptor::from_f32(space.clone(), &at)?);
    }
    Ok(out)
}

/// Nearly normal numbers: sums of uniform ones.
struct Normal {
    state: u64,
}

impl Normal {
    fn next(&mut self) -> f32 {
        let mut sum = 0.0;
        for _ in 0..4 {
            self.state =
                self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            sum += (self.state >> 40) as f32 / (1u64 << 24) as f32 - 0.5;
        }
        // Four uniform numbers have a variance of a third together.
        sum * 3f32.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_place::similarity;

    #[test]
    fn steps_of_a_walk_are_alike_and_walks_are_not() {
        let places = walks(250, 256).unwrap();
        let near = similarity(&places[10], &places[11]).unwrap();
        let far = similarity(&places[10], &places[150]).unwrap();
        assert!(near > 0.98 && far.abs() < 0.4, "{near} and {far}");
    }
}
