//! Public sets of pose graphs: a g2o file of one robot, or a folder with one for each.

use anyhow::Context;
use coma_pose_graph::g2o::{G2oGraph, G2oLimits};
use coma_pose_graph::team;
use std::path::Path;

/// A set's name and its graphs, in the order of the files' names.
pub fn read(path: &Path) -> anyhow::Result<(String, Vec<G2oGraph>)> {
    let name = path.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
    let mut files = vec![path.to_owned()];
    if path.is_dir() {
        let listed = std::fs::read_dir(path).with_context(|| path.display().to_string())?;
        files = listed.map(|file| Ok(file?.path())).collect::<anyhow::Result<_>>()?;
        files.sort();
    }
    let mut graphs = Vec::new();
    for file in &files {
        let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
        let graph = G2oGraph::parse_part(&text, &G2oLimits::default());
        graphs.push(graph.with_context(|| file.display().to_string())?);
    }
    Ok((name, graphs))
}

/// A set's name and its graphs as one.
pub fn whole(path: &Path) -> anyhow::Result<(String, G2oGraph)> {
    let (name, graphs) = read(path)?;
    let whole = team::merged(&graphs).with_context(|| path.display().to_string())?;
    Ok((name, whole))
}
