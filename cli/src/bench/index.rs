//! `coma bench index`: how long it takes to find the most similar of many descriptors.

use super::cpu::{median, timed};
use anyhow::ensure;
use clap::Args;
use coma_place::{Descriptor, ExactIndex, Hit, Index, Space};
use serde::Serialize;
use std::time::Instant;

/// Fills an index with the places of random walks, and looks places up that lie a step beside known ones.
///
/// Real descriptors come in walks: a camera sees much the same from frame to frame. Each walk starts anywhere on the
/// sphere and takes 100 small steps. Exact search compares with every descriptor; approximate search (in programs
/// built with the feature `usearch`) with few, and its recall is the share of the exact search's nearest that it finds.
#[derive(Args)]
pub struct Arguments {
    /// Numbers of keyframes.
    #[arg(long, value_delimiter = ',', default_value = "1000,10000,200000")]
    keyframes: Vec<usize>,
    /// A million keyframes too: half a gigabyte for each index, and some minutes.
    #[arg(long)]
    large: bool,
    /// Values of a descriptor, 1 to 512.
    #[arg(long, default_value_t = 384)]
    dimension: usize,
    /// Queries that are timed.
    #[arg(long, default_value_t = 200)]
    queries: usize,
    /// Neighbours that are asked for.
    #[arg(long, default_value_t = 10)]
    nearest: usize,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row {
    keyframes: usize,
    search: &'static str,
    build_s: f64,
    query_ms: f64,
    query_cpu_ms: f64,
    /// Of the exact search's nearest.
    recall: f64,
    saved_mib: f64,
    load_s: f64,
}

/// Steps of a walk.
const STEPS: usize = 100;
/// Length of a step against the unit vector's.
const STEP: f32 = 0.1;
/// Keyframes with `--large`.
const LARGE: usize = 1_000_000;

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    ensure!(arguments.nearest > 0 && arguments.queries > 0, "--nearest and --queries must be at least 1");
    let mut rows = Vec::new();
    for &keyframes in arguments.keyframes.iter().chain(arguments.large.then_some(&LARGE)) {
        ensure!(keyframes > 0, "--keyframes must be at least 1");
        let mut random = Normal { state: 1 };
        let (places, asked) = walks(keyframes, arguments.queries, arguments.dimension, &mut random)?;
        let (exact, mut row) = filled::<ExactIndex<u32>>(&places);
        let truth = ask(&exact, &asked, arguments.nearest, &mut row);
        ensure!(
            truth.iter().all(|hits| hits.len() == arguments.nearest.min(keyframes)),
            "descriptors were lost"
        );
        saved(&mut row, || exact.to_bytes(), |bytes| Ok(ExactIndex::<u32>::from_bytes(bytes)?.len()))?;
        rows.push(row);
        #[cfg(feature = "usearch")]
        {
            use coma_place::LargeIndex;
            let (large, mut row) = filled::<LargeIndex<u32>>(&places);
            row.search = "approximate";
            let found = ask(&large, &asked, arguments.nearest, &mut row);
            let hit = |(truth, found): (&Vec<Hit<u32>>, &Vec<Hit<u32>>)| {
                truth.iter().filter(|t| found.iter().any(|f| f.key == t.key)).count()
            };
            let hits: usize = truth.iter().zip(&found).map(hit).sum();
            row.recall = hits as f64 / truth.iter().map(Vec::len).sum::<usize>() as f64;
            saved(&mut row, || large.to_bytes(), |bytes| Ok(LargeIndex::<u32>::from_bytes(bytes)?.len()))?;
            rows.push(row);
        }
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
        return Ok(());
    }
    println!(
        "| keyframes | search | build s | query ms, median | query CPU ms | recall@{} | saved MiB | load s |\n\
         |---|---|---|---|---|---|---|---|",
        arguments.nearest
    );
    for r in &rows {
        println!(
            "| {} | {} | {:.2} | {:.3} | {:.3} | {:.3} | {:.1} | {:.2} |",
            r.keyframes, r.search, r.build_s, r.query_ms, r.query_cpu_ms, r.recall, r.saved_mib, r.load_s
        );
    }
    Ok(())
}

/// An index of these descriptors, keys by position.
fn filled<I: Index<u32> + Default>(places: &[Descriptor]) -> (I, Row) {
    let mut index = I::default();
    let begin = Instant::now();
    (0u32..).zip(places).for_each(|(key, descriptor)| index.insert(key, descriptor));
    let row = Row {
        keyframes: places.len(),
        search: "exact",
        build_s: begin.elapsed().as_secs_f64(),
        query_ms: 0.0,
        query_cpu_ms: 0.0,
        recall: 1.0,
        saved_mib: 0.0,
        load_s: 0.0,
    };
    (index, row)
}

fn ask(index: &impl Index<u32>, asked: &[Descriptor], nearest: usize, row: &mut Row) -> Vec<Vec<Hit<u32>>> {
    let (mut wall_ms, mut cpu_ms, mut answers) = (Vec::new(), Vec::new(), Vec::new());
    for query in asked {
        let begin = Instant::now();
        let (hits, ms) = timed(|| index.query(query, nearest, &|_| true));
        wall_ms.push(begin.elapsed().as_secs_f64() * 1e3);
        cpu_ms.push(ms);
        answers.push(hits);
    }
    (row.query_ms, row.query_cpu_ms) = (median(wall_ms), median(cpu_ms));
    answers
}

/// Saves and loads an index; it must come back with as many descriptors.
fn saved(
    row: &mut Row,
    save: impl FnOnce() -> Vec<u8>,
    load: impl FnOnce(&[u8]) -> anyhow::Result<usize>,
) -> anyhow::Result<()> {
    let bytes = save();
    row.saved_mib = bytes.len() as f64 / (1 << 20) as f64;
    let begin = Instant::now();
    ensure!(load(&bytes)? == row.keyframes, "the saved index came back with other descriptors");
    row.load_s = begin.elapsed().as_secs_f64();
    Ok(())
}

/// Descriptors along random walks on the sphere, and others a step beside some of them, evenly picked; the same ones
/// every time.
fn walks(
    count: usize,
    beside: usize,
    dimension: usize,
    random: &mut Normal,
) -> anyhow::Result<(Vec<Descriptor>, Vec<Descriptor>)> {
    let space = Space::new("walks/1")?;
    let mut at = vec![0.0f32; dimension];
    let (mut places, mut asked) = (Vec::with_capacity(count), Vec::with_capacity(beside));
    for k in 0..count {
        if k % STEPS == 0 {
            at.fill(0.0);
            step(&mut at, 1.0, random);
        } else {
            step(&mut at, STEP, random);
        }
        places.push(Descriptor::from_f32(space.clone(), &at)?);
        while asked.len() * count < beside * (k + 1) {
            let mut near = at.clone();
            step(&mut near, STEP, random);
            asked.push(Descriptor::from_f32(space.clone(), &near)?);
        }
    }
    Ok((places, asked))
}

/// A step of this length in any direction, back onto the sphere.
fn step(at: &mut [f32], length: f32, random: &mut Normal) {
    let scale = length / (at.len() as f32).sqrt();
    at.iter_mut().for_each(|v| *v += scale * random.next());
    let norm = at.iter().map(|v| v * v).sum::<f32>().sqrt();
    at.iter_mut().for_each(|v| *v /= norm);
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
        let (places, asked) = walks(250, 5, 256, &mut Normal { state: 1 }).unwrap();
        assert_eq!((places.len(), asked.len()), (250, 5));
        let beside = similarity(&places[0], &asked[0]).unwrap();
        assert!(beside > 0.98, "{beside}");
        let near = similarity(&places[10], &places[11]).unwrap();
        let far = similarity(&places[10], &places[150]).unwrap();
        assert!(near > 0.98 && far.abs() < 0.4, "{near} and {far}");
    }
}
