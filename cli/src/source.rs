//! What agents are to see: specs from the command line as named sequences.

use anyhow::{Context, bail};
use coma_dataset::{Sequence, Spec};
use std::collections::BTreeSet;

/// A sequence and the agent that it is for.
pub struct Source {
    /// The agent's name.
    pub agent: String,
    /// The spec as it was given.
    pub spec: String,
    /// Its frames.
    pub sequence: Box<dyn Sequence>,
}

/// Opens every spec. Agents are named `agent-00`, `agent-01`, ... in the order of the specs, unless a spec
/// names its own (`NAME=SPEC`); a multi-agent folder makes several.
pub fn open(specs: &[String]) -> anyhow::Result<Vec<Source>> {
    let mut out: Vec<Source> = Vec::new();
    for text in specs {
        let spec: Spec = text.parse()?;
        let named = spec.name.is_some();
        for (name, sequence) in coma_dataset::open_all(&spec).with_context(|| text.clone())? {
            let agent = if named { name } else { format!("agent-{:02}", out.len()) };
            out.push(Source { agent, spec: text.clone(), sequence });
        }
    }
    let mut seen = BTreeSet::new();
    for source in &out {
        if !seen.insert(&source.agent) {
            bail!("two agents are named {}: name them apart with NAME=SPEC", source.agent);
        }
    }
    Ok(out)
}
