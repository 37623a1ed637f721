//! `coma inspect graph`: what a file holds, and what can be said of it.

use crate::bench::sets;
use anyhow::{Context, anyhow};
use clap::Args;
use coma_evaluation::{GraphPicture, graph_svg, percentile};
use coma_geometry::Pose;
use coma_pose_graph::certified::{self, Attempt, Start};
use coma_pose_graph::g2o::G2oGraph;
use coma_pose_graph::gnc::{self, RobustSettings, Trust};
use coma_pose_graph::initialise::chordal;
use coma_pose_graph::{Problem, SolverSettings};
use std::path::PathBuf;

/// Solves a pose graph from the file's own poses and says what came of it.
#[derive(Args)]
pub struct GraphArguments {
    /// The g2o file.
    file: PathBuf,
    /// Doubts every measurement that does not join consecutive vertices.
    #[arg(long)]
    robust: bool,
    /// Draws the graph before and after.
    #[arg(long, value_name = "FILE.svg")]
    svg: Option<PathBuf>,
    /// Writes the solved graph.
    #[arg(long, value_name = "FILE.g2o")]
    out: Option<PathBuf>,
    /// Edges to list, those with the largest errors first.
    #[arg(long, default_value_t = 10)]
    worst: usize,
}

/// Runs it.
pub fn graph(arguments: &GraphArguments) -> anyhow::Result<()> {
    let (name, graph) = sets::whole(&arguments.file)?;
    let (problem, given) = graph.problem();
    let settings = SolverSettings::default();
    let odometry: Vec<bool> = graph.edges.iter().map(|e| e.from.abs_diff(e.to) == 1).collect();
    let loops = odometry.iter().filter(|o| !**o).count();
    println!(
        "{name}: {} poses, {} measurements, {loops} of them loops",
        problem.nodes,
        problem.constraints.len()
    );
    let all = vec![1.0; problem.constraints.len()];
    println!("cost at the file's poses: {:.6}", problem.cost(&given, &all));
    let weights =
        if arguments.robust { robust_weights(&problem, &given, &odometry, &settings)? } else { all };
    let attempts =
        certified::solve(&problem, &given, &weights, &settings).context("the graph cannot be solved")?;
    for attempt in &attempts {
        print!("{}", said(attempt));
    }
    let end = attempts.last().ok_or_else(|| anyhow!("nothing was solved"))?;
    println!(
        "The certificate speaks of the isotropic objective{}; what it certifies is a surrogate of the graph with full information.",
        if arguments.robust { " with the final weights" } else { "" }
    );
    println!("{}", residuals(&graph, &problem, &end.solved.poses, &weights, arguments.worst));
    if let Some(path) = &arguments.svg {
        let picture = |title: &str, poses: &[Pose]| GraphPicture {
            title: format!("{name}, {title}"),
            nodes_m: poses.iter().map(|p| p.translation.vector.into()).collect(),
            odometry: ends(&problem, &odometry, true).map(|(a, b, _)| (a, b)).collect(),
            loops: ends(&problem, &odometry, false).map(|(a, b, k)| (a, b, weights[k])).collect(),
        };
        let svg = graph_svg(&[picture("before", &given), picture("after", &end.solved.poses)]);
        let svg = svg.map_err(|e| anyhow!("the graph cannot be drawn: {e}"))?;
        std::fs::write(path, svg).with_context(|| path.display().to_string())?;
        println!("drawn: {}", path.display());
    }
    if let Some(path) = &arguments.out {
        let vertices = graph.vertices.keys().copied().zip(end.solved.poses.iter().copied()).collect();
        let solved = G2oGraph { vertices, ..graph };
        std::fs::write(path, solved.to_text()).with_context(|| path.display().to_string())?;
        println!("written: {}", path.display());
    }
    Ok(())
}

fn ends<'a>(
    problem: &'a Problem,
    odometry: &'a [bool],
    wanted: bool,
) -> impl Iterator<Item = (usize, usize, usize)> + 'a {
    let constraints = problem.constraints.iter().enumerate().zip(odometry);
    constraints.filter(move |(_, o)| **o == wanted).map(|((k, c), _)| (c.from, c.to, k))
}

/// Weights by graduated non-convexity, from the chordal start; odometry is believed.
fn robust_weights(
    problem: &Problem,
    given: &[Pose],
    odometry: &[bool],
    settings: &SolverSettings,
) -> anyhow::Result<Vec<f64>> {
    let trusted: Vec<f64> = odometry.iter().map(|o| if *o { 1.0 } else { 0.0 }).collect();
    // By odometry alone where it holds the graph: false loops would bend a start that they are part of.
    let start =
        chordal(problem, given, &trusted).or_else(|_| chordal(problem, given, &vec![1.0; odometry.len()]))?;
    let trust: Vec<Trust> = odometry.iter().map(|o| if *o { Trust::Full } else { Trust::Doubted }).collect();
    let solved = gnc::solve(problem, &start, &trust, &RobustSettings::default(), settings)?;
    let lost = solved.weights.iter().filter(|w| **w < 0.5).count();
    println!("weights: {lost} loops have lost theirs in {} rounds", solved.rounds);
    Ok(solved.weights)
}

fn said(attempt: &Attempt) -> String {
    let c = &attempt.certificate;
    let start = match attempt.start {
        Start::Given => "the file's poses",
        Start::Chordal => "the chordal relaxation",
    };
    let verdict = if c.holds() {
        "the global minimum".to_owned()
    } else if c.smallest < 0.0 {
        "NOT certified: there is a lower minimum, or this is none".to_owned()
    } else {
        format!("NOT certified: the point is not stationary ({:.1e})", c.stationarity)
    };
    format!(
        "from {start}: cost {:.6} after {} steps; isotropic objective {:.6} after {} more\n\
         \x20 certificate: smallest eigenvalue {:.3e}, largest {:.3e} (ratio {:.1e}): {verdict}\n",
        attempt.solved.cost,
        attempt.solved.iterations,
        attempt.isotropic.cost,
        attempt.isotropic.iterations,
        c.smallest,
        c.largest,
        c.smallest / c.largest
    )
}

fn residuals(graph: &G2oGraph, problem: &Problem, poses: &[Pose], weights: &[f64], worst: usize) -> String {
    let squared: Vec<f64> = problem.constraints.iter().map(|c| c.squared_error(poses)).collect();
    let at = |share| percentile(&squared, share).unwrap_or(f64::NAN);
    let mut out = format!(
        "squared errors (6 degrees of freedom): median {:.3}, 95 % below {:.3}, largest {:.3}\n",
        at(50.0),
        at(95.0),
        at(100.0)
    );
    let mut order: Vec<usize> = (0..squared.len()).collect();
    order.sort_by(|a, b| squared[*b].total_cmp(&squared[*a]));
    out += "| from | to | squared error | weight |\n|---|---|---|---|\n";
    for k in order.into_iter().take(worst) {
        let e = &graph.edges[k];
        out += &format!("| {} | {} | {:.3} | {:.3} |\n", e.from, e.to, squared[k], weights[k]);
    }
    out
}
