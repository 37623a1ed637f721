//! `coma bench graph --blocks`: the same graphs without anyone who holds them whole: rounds and bytes.

use super::clock::{Spent, timed};
use super::sets;
use clap::Args;
use coma_geometry::Pose;
use coma_pose_graph::blocks::{BlockSettings, Network, Simulation, blocks};
use coma_pose_graph::initialise::chordal;
use coma_pose_graph::{Problem, SolverSettings};
use serde::Serialize;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// The network that blocks talk over.
#[derive(Args, Clone, Debug)]
pub struct NetworkArguments {
    /// Share of messages that is lost.
    #[arg(long, default_value_t = 0.0)]
    loss: f64,
    /// Share of messages that arrives twice.
    #[arg(long, default_value_t = 0.05)]
    repeated: f64,
    /// Longest delay of a message, in rounds.
    #[arg(long, default_value_t = 1.0)]
    delay: f64,
    /// Seed of losses, delays and steps.
    #[arg(long, default_value_t = 1)]
    network_seed: u64,
    /// Most rounds.
    #[arg(long, default_value_t = 5000)]
    pub rounds: u64,
}

impl NetworkArguments {
    /// As the simulation takes it.
    pub fn network(&self) -> Network {
        Network {
            loss: self.loss.clamp(0.0, 1.0),
            repeated: self.repeated.clamp(0.0, 1.0),
            delay_rounds: self.delay.clamp(0.0, 1000.0),
            seed: self.network_seed,
        }
    }
}

#[derive(Debug, Serialize)]
struct Row {
    set: String,
    blocks: usize,
    loss: f64,
    central_cost: f64,
    /// Above the central cost, as a share; `None` if not every node has found its place.
    excess: Option<f64>,
    rounds_to_1_percent: Option<u64>,
    rounds_to_0_1_percent: Option<u64>,
    messages: u64,
    bytes: u64,
    bytes_per_block: u64,
    spent: Spent,
}

/// Solves each set cut into each number of blocks, until the cost is within 0.1 % of the central one.
pub fn run(
    files: &[PathBuf],
    counts: &[usize],
    arguments: &NetworkArguments,
    json: bool,
) -> anyhow::Result<()> {
    let mut rows = Vec::new();
    for file in files {
        rows.extend(set(file, counts, arguments)?);
    }
    if json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
    } else {
        print!("{}", table(&rows));
    }
    Ok(())
}

fn set(file: &Path, counts: &[usize], arguments: &NetworkArguments) -> anyhow::Result<Vec<Row>> {
    let (name, graph) = sets::whole(file)?;
    let (problem, given) = graph.problem();
    let weights = vec![1.0; problem.constraints.len()];
    let start = chordal(&problem, &given, &weights)?;
    let central = problem.solve(&start, &weights, &SolverSettings::default())?.cost;
    counts.iter().map(|count| row(&name, &problem, &given, central, *count, arguments)).collect()
}

fn row(
    name: &str,
    problem: &Problem,
    given: &[Pose],
    central_cost: f64,
    count: usize,
    arguments: &NetworkArguments,
) -> anyhow::Result<Row> {
    let weights = vec![1.0; problem.constraints.len()];
    let cut = blocks(problem, &weights, &vec![false; weights.len()], count);
    let network = arguments.network();
    let begin = |node: u32| given[node as usize];
    let mut simulation = Simulation::new(cut, begin, BlockSettings::default(), network);
    let (mut excess, mut to_1_percent, mut to_0_1_percent) = (None, None, None);
    let mut spent = Spent::default();
    while to_0_1_percent.is_none() && simulation.rounds() < arguments.rounds && !simulation.is_settled() {
        let (stepped, took) = timed(|| simulation.round());
        stepped?;
        spent.cpu_ms += took.cpu_ms;
        spent.wall_ms += took.wall_ms;
        let poses: Option<Vec<Pose>> = simulation.poses(problem.nodes).into_iter().collect();
        excess = poses.map(|poses| problem.cost(&poses, &weights) / central_cost - 1.0);
        let within = |share: f64| excess.is_some_and(|e| e <= share).then(|| simulation.rounds());
        to_1_percent = to_1_percent.or(within(0.01));
        to_0_1_percent = to_0_1_percent.or(within(0.001));
    }
    let (messages, bytes) = (simulation.traffic.messages, simulation.traffic.bytes);
    Ok(Row {
        set: name.to_owned(),
        blocks: count,
        loss: network.loss,
        central_cost,
        excess,
        rounds_to_1_percent: to_1_percent,
        rounds_to_0_1_percent: to_0_1_percent,
        messages,
        bytes,
        bytes_per_block: bytes / count.max(1) as u64,
        spent,
    })
}

fn table(rows: &[Row]) -> String {
    let mut out = String::from(
        "| set | blocks | loss | central cost | above it | rounds to 1 % | to 0.1 % | messages | kB | kB for each block | CPU ms |\n\
         |---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let rounds = |r: Option<u64>| r.map_or("not reached".to_owned(), |r| r.to_string());
    for r in rows {
        let excess = r.excess.map_or("not placed".to_owned(), |e| format!("{:.3} %", e * 100.0));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {:.6} | {excess} | {} | {} | {} | {:.1} | {:.1} | {:.0} |",
            r.set,
            r.blocks,
            r.loss,
            r.central_cost,
            rounds(r.rounds_to_1_percent),
            rounds(r.rounds_to_0_1_percent),
            r.messages,
            r.bytes as f64 / 1e3,
            r.bytes_per_block as f64 / 1e3,
            r.spent.cpu_ms
        );
    }
    out
}
