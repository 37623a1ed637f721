//! `coma bench team`: how time and bytes grow with the team, for one central solve and block by block.

use super::blocks::NetworkArguments;
use super::clock::{Spent, timed};
use crate::progress;
use crate::synth::graph::{Team, graph};
use anyhow::{Context, anyhow, ensure};
use clap::Args;
use coma_evaluation::{Growth, Line, growth_svg};
use coma_geometry::{Pose, SubmapId};
use coma_pose_graph::blocks::cut::blocks_of;
use coma_pose_graph::blocks::{BlockAgent, BlockSettings, Simulation};
use coma_pose_graph::g2o::G2oGraph;
use coma_pose_graph::team::{self, Believed};
use coma_pose_graph::{Component, GlobalSettings, LoopWeight, solve};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Solves the graphs of `coma synth graph` for teams of several sizes.
///
/// Central: everything that a cold solve of the dpgo service does, from log entries to poses and verdicts. Block by
/// block: each agent its own block, until the cost is within 0.1 % of the central one.
#[derive(Args)]
pub struct Arguments {
    /// Sizes of teams, by commas.
    #[arg(long, value_delimiter = ',', default_value = "10,50,100,200")]
    sizes: Vec<usize>,
    #[command(flatten)]
    team: Team,
    #[command(flatten)]
    network: NetworkArguments,
    /// Only the central solve.
    #[arg(long)]
    central_only: bool,
    /// Draws the growth.
    #[arg(long, value_name = "FILE.svg")]
    svg: Option<PathBuf>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Row {
    agents: usize,
    submaps: usize,
    loops: usize,
    loops_used: usize,
    central: Spent,
    central_steps: u32,
    cost: f64,
    blocks: Option<Blocks>,
}

#[derive(Debug, Serialize)]
struct Blocks {
    rounds: u64,
    /// Above the central cost, as a share; `None` if not every submap has found its place.
    excess: Option<f64>,
    /// Rounds in which all have moved together.
    coarse_rounds: u64,
    bytes_per_agent: u64,
    cpu_ms_per_agent: f64,
    wall_ms: f64,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut rows = Vec::new();
    if !arguments.json {
        print!("{HEAD}");
    }
    for size in &arguments.sizes {
        let row = row(&Team { agents: *size, ..arguments.team.clone() }, arguments)?;
        if !arguments.json {
            println!("{}", line(&row));
        }
        rows.push(row);
    }
    if let Some(path) = &arguments.svg {
        let svg = growth_svg(&panels(&rows)).map_err(|e| anyhow!("the growth cannot be drawn: {e}"))?;
        std::fs::write(path, svg).with_context(|| path.display().to_string())?;
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
    }
    Ok(())
}

fn row(team: &Team, arguments: &Arguments) -> anyhow::Result<Row> {
    let graph = graph(team)?;
    let (entries, vertices) = team::entries(std::slice::from_ref(&graph), Believed::Consecutive, None)?;
    let (solution, central) = timed(|| solve(&entries, &GlobalSettings::default()));
    ensure!(solution.components.len() == 1, "the team's graph fell into {} maps", solution.components.len());
    let component = &solution.components[0];
    let blocks = match arguments.central_only {
        true => None,
        false => Some(by_blocks(&graph, component, &vertices, team, &arguments.network)?),
    };
    Ok(Row {
        agents: team.agents,
        submaps: entries.nodes.len(),
        loops: component.loops.len(),
        loops_used: component.loops.iter().filter(|l| l.weight > 0.5).count(),
        central,
        central_steps: component.iterations,
        cost: component.cost,
        blocks,
    })
}

/// The same graph with the weights that the central solve has found, each agent its own block.
fn by_blocks(
    graph: &G2oGraph,
    component: &Component,
    vertices: &BTreeMap<SubmapId, u64>,
    team: &Team,
    network: &NetworkArguments,
) -> anyhow::Result<Blocks> {
    let (problem, _) = graph.problem();
    let ends = |l: &LoopWeight| (vertices[&l.from], vertices[&l.to]);
    let weight: BTreeMap<(u64, u64), f64> = component.loops.iter().map(|l| (ends(l), l.weight)).collect();
    let weights: Vec<f64> =
        graph.edges.iter().map(|e| weight.get(&(e.from, e.to)).copied().unwrap_or(1.0)).collect();
    let central: BTreeMap<u64, Pose> =
        component.map_from_submap.iter().map(|(submap, pose)| (vertices[submap], *pose)).collect();
    let central: Vec<Pose> = central.into_values().collect();
    let goal = problem.cost(&central, &weights);
    let of: Vec<u32> = (0..problem.nodes).map(|node| (node / team.submaps) as u32).collect();
    let cut = blocks_of(&problem, &weights, &vec![false; weights.len()], &of);
    let begin = |node: u32| central[node as usize];
    let mut simulation = Simulation::new(cut, begin, BlockSettings::default(), network.network());
    let mut excess = None;
    let (mut cpu_ms, mut wall_ms) = (0.0, 0.0);
    let bar = progress::spinner(&format!("{} agents, block by block", team.agents));
    while simulation.rounds() < network.rounds
        && !simulation.is_settled()
        && !excess.is_some_and(|e: f64| e <= 1e-3)
    {
        let (stepped, took) = timed(|| simulation.round());
        stepped?;
        cpu_ms += took.cpu_ms;
        wall_ms += took.wall_ms;
        let placed: Option<Vec<Pose>> = simulation.poses(problem.nodes).into_iter().collect();
        excess = placed.map(|poses| problem.cost(&poses, &weights) / goal - 1.0);
        let above =
            excess.map_or("not placed".into(), |e| format!("{:.2} % above the central cost", e * 100.0));
        bar.set_message(format!("round {}, {above}", simulation.rounds()));
    }
    bar.finish_and_clear();
    Ok(Blocks {
        rounds: simulation.rounds(),
        excess,
        coarse_rounds: simulation.agents().iter().map(BlockAgent::coarse_rounds).min().unwrap_or(0),
        bytes_per_agent: simulation.traffic.bytes / team.agents as u64,
        cpu_ms_per_agent: cpu_ms / team.agents as f64,
        wall_ms,
    })
}

fn panels(rows: &[Row]) -> Vec<Growth> {
    let line = |name: &str, value: &dyn Fn(&Row) -> Option<f64>| Line {
        name: name.into(),
        points: rows.iter().filter_map(|r| Some((r.agents as f64, value(r)?))).collect(),
    };
    let panel = |y: &str, lines| Growth { y: y.into(), x: "agents".into(), lines };
    let of_blocks = |f: fn(&Blocks) -> Option<f64>| move |r: &Row| f(r.blocks.as_ref()?);
    vec![
        panel(
            "solve, s of the processor",
            vec![
                line("central, one agent", &|r| Some(r.central.cpu_ms / 1e3)),
                line("block by block, each agent", &of_blocks(|b| Some(b.cpu_ms_per_agent / 1e3))),
            ],
        ),
        panel(
            "bytes of each agent, MB",
            vec![line("block by block", &of_blocks(|b| Some(b.bytes_per_agent as f64 / 1e6)))],
        ),
    ]
}

const HEAD: &str = "\
| agents | submaps | loops | used | central wall s | central CPU s | steps | cost | block rounds | together | above central | kB an agent | CPU s an agent | wall s, all in one process |
|---|---|---|---|---|---|---|---|---|---|---|---|---|---|
";

fn line(r: &Row) -> String {
    let blocks = match &r.blocks {
        Some(b) => format!(
            "{} | {} | {} | {:.0} | {:.2} | {:.1}",
            b.rounds,
            b.coarse_rounds,
            b.excess.map_or("not placed".into(), |e| format!("{:.3} %", e * 100.0)),
            b.bytes_per_agent as f64 / 1e3,
            b.cpu_ms_per_agent / 1e3,
            b.wall_ms / 1e3
        ),
        None => " | | | | |".into(),
    };
    format!(
        "| {} | {} | {} | {} | {:.2} | {:.2} | {} | {:.1} | {blocks} |",
        r.agents,
        r.submaps,
        r.loops,
        r.loops_used,
        r.central.wall_ms / 1e3,
        r.central.cpu_ms / 1e3,
        r.central_steps,
        r.cost
    )
}
