//! The graph is given to dpgo whenever it changed, and its corrections are taken over as a whole.

use crate::convert;
use crate::node::{Node, Unfinished};
use crate::task::peers::Peers;
use coma_geometry::AgentId;
use coma_runtime::Channel;
use coma_slam::log::{Payload, SolveDigest, VersionVector};
use coma_slam::loop_closure::corrections::Generation;
use coma_wire::v1::dpgo_client::DpgoClient;
use coma_wire::{At, Wire, v1};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;
use tracing::{debug, info, warn};

/// Changes that come together are solved together.
const GATHER: Duration = Duration::from_millis(200);
/// How long to wait before a service that failed is asked again.
const RETRY: Duration = Duration::from_millis(500);
/// Entries in one call.
const CHUNK: usize = 512;

/// What dpgo was given.
#[derive(Default)]
struct Given {
    graph: String,
    have: VersionVector,
}

/// Solves after every change of the graph.
pub async fn run(node: Arc<Node>, peers: Arc<Peers>, mut client: DpgoClient<Channel>) {
    let mut given = Given::default();
    loop {
        // Counted from before it is taken, so that a drain never sees neither.
        let unfinished = Unfinished::begin(&node);
        if !node.lock().closer.take_graph_changed() {
            agree(&node, &peers).await;
            drop(unfinished);
            node.solve_wake.notified().await;
            continue;
        }
        tokio::time::sleep(GATHER).await;
        node.lock().closer.take_graph_changed();
        let mut failed = false;
        while let Err(e) = solve(&node, &mut client, &mut given).await {
            let error = format!("{e:#}");
            if let Some(status) = e.downcast_ref::<tonic::Status>().filter(|s| coma_wire::is_full(s)) {
                // Asked again when there is more to solve: by then it may have been given more room.
                warn!(error, "the graph has no room for what is new");
                let text = format!("{}: the map is no longer corrected", status.message());
                node.lock().warn_once(text);
                given.have.clear();
                break;
            }
            if failed {
                debug!(error, "the graph could not be solved yet");
            } else {
                warn!(error, "the graph could not be solved; tried again until it is");
            }
            failed = true;
            // A dpgo that started anew has nothing.
            given.have.clear();
            tokio::time::sleep(RETRY).await;
        }
        agree(&node, &peers).await;
    }
}

/// Where another agent's result of the same cut is to be taken instead of the own one, it is fetched and taken.
async fn agree(node: &Node, peers: &Peers) {
    let live: BTreeSet<AgentId> = node.live_agents().into_iter().collect();
    let differing: Vec<(AgentId, Generation)> = {
        let knowledge = node.lock();
        let served = knowledge.corrections.components().iter().map(|c| &c.generation);
        let agreement = knowledge.closer.agreement();
        let instead = |served: &Generation| {
            let (author, digest) =
                agreement.instead_of(served, &knowledge.agent, |agent| live.contains(agent))?;
            Some((author.clone(), Generation { digest, ..served.clone() }))
        };
        served.filter_map(instead).collect()
    };
    for (author, generation) in differing {
        let message = convert::generation(&generation);
        let Some(component) = peers.fetch_result(&author, message).await else { continue };
        let correction = match convert::correction(component.clone(), &At::Root("component")) {
            Ok(correction) if correction.generation == generation => correction,
            Ok(_) => continue,
            Err(e) => {
                warn!(%author, error = %e, "a peer served a result that cannot be read");
                continue;
            }
        };
        let mut knowledge = node.lock();
        // A newer solve may have come meanwhile.
        let is_of = |c: &&mut v1::Component| {
            c.generation.as_ref().is_some_and(|g| {
                let wanted = component.generation.as_ref();
                wanted.is_some_and(|wanted| g.map_id == wanted.map_id && g.cut == wanted.cut)
            })
        };
        let Some(slot) = knowledge.solved.components.iter_mut().find(is_of) else { continue };
        *slot = component.clone();
        knowledge.corrections.adopt(correction);
        drop(knowledge);
        metrics::counter!("coma_agent_results_adopted_total").increment(1);
        info!(map = %generation.map_id, %author, "another agent's result of the same cut was adopted");
        node.publish(v1::watch_response::Event::Correction(component));
    }
}

async fn solve(node: &Node, client: &mut DpgoClient<Channel>, given: &mut Given) -> anyhow::Result<()> {
    let (entries, heads) = {
        let knowledge = node.lock();
        // A log that forked gets shorter, which a graph does not: it is put anew, under another name.
        let graph = match knowledge.replica.conflicts().count() {
            0 => knowledge.agent.to_string(),
            conflicts => format!("{}.{conflicts}", knowledge.agent),
        };
        if given.graph != graph {
            *given = Given { graph, have: VersionVector::new() };
        }
        let missing: Vec<v1::Entry> =
            knowledge.replica.missing(&given.have, usize::MAX).map(Wire::to_wire).collect();
        (missing, knowledge.replica.heads())
    };
    for chunk in entries.chunks(CHUNK) {
        let request = v1::PutEntriesRequest { graph: given.graph.clone(), entries: chunk.to_vec() };
        let response = client.put_entries(request).await?.into_inner();
        given.have = coma_wire::version_vector(response.have, &At::Root("have"))?;
    }
    let request = v1::SolveRequest { graph: given.graph.clone(), at_least: Some(heads.to_wire()) };
    let response = client.solve(request).await?.into_inner();
    let at = At::Root("components");
    let mut corrections = Vec::new();
    for (i, component) in response.components.iter().enumerate() {
        corrections.push(convert::correction(component.clone(), &at.index(i))?);
    }
    let mut knowledge = node.lock();
    // Every agent says what its solver made of a cut, once, so that a difference is seen by all.
    let own = knowledge.agent.clone();
    let mut digests = Vec::new();
    for c in &corrections {
        let mine = c.map_from_submap.keys().any(|id| id.agent == own);
        let shared = c.map_from_submap.keys().any(|id| id.agent != own);
        let generation = convert::generation(&c.generation);
        let known = knowledge.own_results.iter().any(|b| b.generation.as_ref() == Some(&generation));
        if mine && shared && !known {
            let g = c.generation.clone();
            digests.push(SolveDigest { map_id: g.map_id, cut: g.cut, digest: g.digest });
        }
    }
    let joined = corrections.len();
    knowledge.corrections.replace(corrections);
    let is_new = |rejected: &&v1::RejectedEntry| !knowledge.solved.rejected_entries.contains(rejected);
    for rejected in response.rejected_entries.iter().filter(is_new) {
        // Two agents may decide one pair: expected, and harmless.
        debug!(key = ?rejected.key, message = %rejected.message, "an entry is not used in the graph");
    }
    knowledge.own_results.clone_from(&response.components);
    knowledge.solved = response.clone();
    for digest in digests {
        if let Err(e) = knowledge.write(&Payload::SolveDigest(digest)) {
            warn!(error = %format!("{e:#}"), "a digest could not be written");
        }
    }
    drop(knowledge);
    info!(components = joined, "graph solved");
    for component in response.components {
        node.publish(v1::watch_response::Event::Correction(component));
    }
    Ok(())
}
