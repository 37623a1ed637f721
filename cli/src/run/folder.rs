//! The run's folder, but for its scores: `run.json`, `loops.json`, `graph.g2o`, trajectories, maps.

use super::facts::Facts;
use super::gather::Results;
use anyhow::Context;
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Writes a file so that it is there whole or not at all.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    write_in_pieces(path, |out| Ok(out.write_all(bytes)?))
}

/// As [`write_atomically`], of bytes that are never in memory together.
pub fn write_in_pieces(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let shown = || path.display().to_string();
    let part = path.with_extension("part");
    let mut out = BufWriter::new(File::create(&part).with_context(shown)?);
    write(&mut out).with_context(shown)?;
    out.flush().with_context(shown)?;
    std::fs::rename(&part, path).with_context(shown)
}

/// File of one agent's trajectory in one component, below `trajectories/`: `<agent>.tum` for the component that
/// holds most of its frames, `<agent>.component-N.tum` for others.
pub fn trajectory_name(facts: &Facts, agent: usize, component: usize) -> String {
    let count = |c: usize| facts.agents[agent].poses.iter().filter(|p| p.component == c).count();
    let components: BTreeSet<usize> = facts.agents[agent].poses.iter().map(|p| p.component).collect();
    let main = components.iter().copied().max_by_key(|c| (count(*c), usize::MAX - c));
    let name = &facts.agents[agent].name;
    if main == Some(component) { format!("{name}.tum") } else { format!("{name}.component-{component}.tum") }
}

/// Writes everything that needs no truth. `stamps` are the texts of each agent's stamps.
pub fn write(out: &Path, facts: &Facts, results: &Results<'_>, stamps: &[Vec<String>]) -> anyhow::Result<()> {
    let trajectories = out.join("trajectories");
    std::fs::create_dir_all(&trajectories).with_context(|| trajectories.display().to_string())?;
    for ((agent, component), poses) in &results.trajectories {
        let lines = poses.iter().map(|(frame, pose)| (stamps[*agent][*frame].as_str(), pose));
        let path = trajectories.join(trajectory_name(facts, *agent, *component));
        write_atomically(&path, coma_geometry::tum::format(lines).as_bytes())?;
    }
    for (component, map) in facts.components.iter().zip(&results.maps) {
        if !component.map.is_empty() {
            write_in_pieces(&out.join(&component.map), |file| map.write(file))?;
        }
    }
    write_atomically(&out.join("graph.g2o"), results.g2o.as_bytes())?;
    write_atomically(&out.join("loops.json"), &serde_json::to_vec_pretty(&results.loops)?)?;
    write_atomically(&out.join("run.json"), &serde_json::to_vec(facts)?)
}
