//! The graph's edges against the truth: are they as certain as they claim?

use super::Read;
use crate::run::facts::{EdgeFacts, End};
use coma_evaluation::Edge;
use coma_geometry::Pose;

/// Odometry edges and accepted loops whose true motion is known.
pub fn normalised(read: &Read) -> (Vec<Edge>, Vec<Edge>) {
    let odometry = read.facts.odometry.iter().filter_map(|e| edge(read, e)).collect();
    let accepted = read.loops.iter().filter(|l| l.verdict == "accepted");
    (odometry, accepted.filter_map(|l| edge(read, l.edge.as_ref()?)).collect())
}

fn edge(read: &Read, facts: &EdgeFacts) -> Option<Edge> {
    let truth = |end: &End| -> Option<Pose> {
        let agent = read.facts.agents.iter().position(|a| a.name == end.submap.agent.as_str())?;
        read.sources[agent].sequence.truth(end.frame?)
    };
    let truth = truth(&facts.from)?.inv_mul(&truth(&facts.to)?);
    Some(Edge { measured: facts.from_from_to, information: facts.information, truth })
}
