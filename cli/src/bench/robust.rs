//! `coma bench robust`: false loops against the public sets: do they lose, and do the true ones win?

use super::clock::{Spent, timed};
use super::sets;
use anyhow::{bail, ensure};
use clap::Args;
use coma_geometry::{Epoch, Matrix6, Pose, SubmapId, se3};
use coma_pose_graph::residual::{residual, squared_mahalanobis};
use coma_pose_graph::team::{self, Believed};
use coma_pose_graph::{Component, Edge, EdgeKey, EdgeKind, GlobalSettings, GraphEntries, solve};
use nalgebra::{Quaternion, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Adds false loops to pose graphs and prints what became of them, and how far the map moved.
///
/// A false loop is a random pose (rotation uniform, translation uniform in the map's extent) between random submaps, of
/// different robots where there are several, more than three sigma from the truth. The optimum without them is the
/// reference.
#[derive(Args)]
pub struct Arguments {
    /// g2o files of one robot, or folders with one file for each robot.
    #[arg(required = true)]
    sets: Vec<PathBuf>,
    /// False loops as shares of the final number of loops (between robots, where there are several).
    #[arg(long, value_delimiter = ',', default_value = "0.3,0.6")]
    shares: Vec<f64>,
    /// Standard deviations of every measurement, metres and radians, instead of the files' information.
    #[arg(long, value_delimiter = ',', value_name = "M,RAD")]
    edge_sigma: Option<Vec<f64>>,
    /// Number of seeds.
    #[arg(long, default_value_t = 10)]
    seeds: u64,
    /// Settings of the solver (TOML; the `solve` table of a dpgo service's settings).
    #[arg(long)]
    settings: Option<PathBuf>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Row {
    set: String,
    share: f64,
    seed: u64,
    false_loops: usize,
    true_loops: usize,
    components: usize,
    /// Position difference to the optimum without false loops; `None` if the map fell apart.
    rms_m: Option<f64>,
    /// RMS length of the translation residual over all edges at the optimum without false loops.
    clean_residual_rms_m: f64,
    false_used: usize,
    true_used: usize,
    solve: Spent,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let settings: GlobalSettings = coma_runtime::load(arguments.settings.as_deref(), "COMA_SOLVE")?;
    let information = match arguments.edge_sigma.as_deref() {
        None => None,
        Some([m, rad]) if *m > 0.0 && *rad > 0.0 => Some(team::information_of(*m, *rad)),
        Some(other) => bail!("--edge-sigma is {other:?}: two positive numbers are needed"),
    };
    for share in &arguments.shares {
        ensure!((0.0..0.95).contains(share), "--shares holds {share}: 0 to 0.95 is allowed");
    }
    let mut rows = Vec::new();
    for set in &arguments.sets {
        let clean = Clean::new(set, information, &settings)?;
        for share in &arguments.shares {
            for seed in 0..arguments.seeds {
                rows.push(clean.contested(*share, seed, &settings));
            }
        }
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
    } else {
        print!("{}", table(&rows));
    }
    Ok(())
}

/// A set and its optimum without false loops.
struct Clean {
    set: String,
    entries: GraphEntries,
    component: Component,
    residual_rms_m: f64,
}

impl Clean {
    fn new(path: &Path, information: Option<Matrix6>, settings: &GlobalSettings) -> anyhow::Result<Self> {
        let (set, graphs) = sets::read(path)?;
        // What a robot measured of itself; who doubts that has no map to begin with.
        let believed = if path.is_dir() { Believed::WithinARobot } else { Believed::Consecutive };
        let (entries, _) = team::entries(&graphs, believed, information)?;
        let mut solution = solve(&entries, settings);
        ensure!(solution.components.len() == 1, "{set}: the graph is not one component without false loops");
        let component = solution.components.remove(0);
        let squares: Vec<f64> = entries
            .edges
            .iter()
            .map(|e| {
                residual(
                    &component.map_from_submap[&e.from],
                    &component.map_from_submap[&e.to],
                    &e.from_from_to,
                )
            })
            .map(|e| e.fixed_rows::<3>(0).norm_squared())
            .collect();
        let residual_rms_m = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        Ok(Clean { set, entries, component, residual_rms_m })
    }

    fn contested(&self, share: f64, seed: u64, settings: &GlobalSettings) -> Row {
        let several = self.component.agents.len() > 1;
        let true_loops = self.entries.edges.iter().filter(|e| e.kind == EdgeKind::Loop).count();
        let false_loops = (share / (1.0 - share) * true_loops as f64).round() as usize;
        let mut entries = self.entries.clone();
        let added = self.add_false_loops(&mut entries, false_loops, several, seed);
        let (solution, spent) = timed(|| solve(&entries, settings));
        let used = |wanted: bool| {
            let loops = solution.components.iter().flat_map(|c| &c.loops);
            loops.filter(|l| added.contains(&l.key) == wanted && l.weight > 0.5).count()
        };
        Row {
            set: self.set.clone(),
            share,
            seed,
            false_loops,
            true_loops,
            components: solution.components.len(),
            rms_m: (solution.components.len() == 1).then(|| rms_m(&self.component, &solution.components[0])),
            clean_residual_rms_m: self.residual_rms_m,
            false_used: used(true),
            true_used: used(false),
            solve: spent,
        }
    }

    /// Gives the keys of the loops that it added.
    fn add_false_loops(
        &self,
        entries: &mut GraphEntries,
        count: usize,
        between_robots: bool,
        seed: u64,
    ) -> BTreeSet<EdgeKey> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let poses: Vec<(&SubmapId, &Pose)> = self.component.map_from_submap.iter().collect();
        let (mut least, mut most) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
        for (_, pose) in &poses {
            least = least.inf(&pose.translation.vector);
            most = most.sup(&pose.translation.vector);
        }
        let mut pairs: BTreeSet<(SubmapId, SubmapId)> = entries
            .edges
            .iter()
            .flat_map(|e| [(e.from.clone(), e.to.clone()), (e.to.clone(), e.from.clone())])
            .collect();
        let mut added = BTreeSet::new();
        while added.len() < count {
            let (from, map_from_from) = poses[random.random_range(0..poses.len())];
            let (to, map_from_to) = poses[random.random_range(0..poses.len())];
            let map_from_wrong = Pose::from_parts(
                Translation3::from(Vector3::from_fn(|k, _| {
                    least[k] + random.random::<f64>() * (most[k] - least[k])
                })),
                any_rotation(&mut random),
            );
            let information = entries.edges[random.random_range(0..self.entries.edges.len())].information;
            let from_from_to = map_from_from.inv_mul(&map_from_wrong);
            let error = residual(map_from_from, map_from_to, &from_from_to);
            let near = squared_mahalanobis(&error, &information) <= 9.0;
            let same = from == to || (between_robots && from.agent == to.agent);
            if near || same || !pairs.insert((from.clone(), to.clone())) {
                continue;
            }
            pairs.insert((to.clone(), from.clone()));
            // Beyond every sequence of the sets.
            let sequence = 1_000_000 + added.len() as u64;
            let key = EdgeKey { agent: from.agent.clone(), epoch: Epoch(0), sequence };
            added.insert(key.clone());
            let (from, to, kind) = (from.clone(), to.clone(), EdgeKind::Loop);
            entries.edges.push(Edge { key, kind, from, to, from_from_to, information });
        }
        added
    }
}

/// Uniform over all rotations (Shoemake).
fn any_rotation(random: &mut ChaCha8Rng) -> UnitQuaternion<f64> {
    let (u, v, w): (f64, f64, f64) = (random.random(), random.random(), random.random());
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    let (v, w) = (std::f64::consts::TAU * v, std::f64::consts::TAU * w);
    UnitQuaternion::from_quaternion(Quaternion::new(b * w.cos(), a * v.sin(), a * v.cos(), b * w.sin()))
}

/// Both have the frame of the same submap.
fn rms_m(a: &Component, b: &Component) -> f64 {
    let squares = a.map_from_submap.iter().map(|(submap, pose)| match b.map_from_submap.get(submap) {
        Some(other) => se3::distance(pose, other).0.powi(2),
        None => f64::NAN,
    });
    (squares.sum::<f64>() / a.map_from_submap.len() as f64).sqrt()
}

fn table(rows: &[Row]) -> String {
    let mut out = String::from(
        "| set | share | seed | false | maps | RMS to clean mm | clean residual mm | false used | true used | CPU ms |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
    );
    for r in rows {
        let rms = r.rms_m.map_or("fell apart".into(), |m| format!("{:.1}", m * 1e3));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {rms} | {:.1} | {} | {} of {} | {:.0} |",
            r.set,
            r.share,
            r.seed,
            r.false_loops,
            r.components,
            r.clean_residual_rms_m * 1e3,
            r.false_used,
            r.true_used,
            r.true_loops,
            r.solve.cpu_ms
        );
    }
    for group in rows.chunk_by(|a, b| (&a.set, a.share) == (&b.set, b.share)) {
        let count = |good: &dyn Fn(&Row) -> bool| group.iter().filter(|r| good(r)).count();
        let _ = writeln!(
            out,
            "{} at {}: RMS at most 20 mm in {} of {}, at most 20 % of the clean residual in {}; no false loop used in {}; 90 % of the true used in {}",
            group[0].set,
            group[0].share,
            count(&|r| r.rms_m.is_some_and(|m| m <= 0.02)),
            group.len(),
            count(&|r| r.rms_m.is_some_and(|m| m <= 0.2 * r.clean_residual_rms_m)),
            count(&|r| r.false_used == 0),
            count(&|r| 10 * r.true_used >= 9 * r.true_loops)
        );
    }
    out
}
