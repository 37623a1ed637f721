//! Candidates are verified one by one: evidence is fetched, views are registered, the verdict is written.

use crate::evidence;
use crate::node::{Node, Unfinished};
use crate::task::peers::Peers;
use coma_geometry::SubmapId;
use coma_registration::{Outcome, Prepared, Reason, Side};
use coma_slam::log::{Evidence, LoopOutcome};
use coma_slam::loop_closure::Candidate;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;
use tracing::{debug, info, warn};

/// Views that are kept ready: an anchor is often tried with several others.
const READY_VIEWS: usize = 24;

/// Verifies until the node ends.
pub async fn run(node: Arc<Node>, peers: Arc<Peers>) {
    let mut ready = ReadyViews::default();
    loop {
        let live = node.live_agents();
        let now_s = node.now_s();
        let next = node.lock().closer.next_to_verify(|agent| live.contains(agent), now_s);
        let Some(candidate) = next else {
            // A candidate may come due by the clock alone: takeovers and retries.
            let _ = tokio::time::timeout(Duration::from_millis(500), node.verify_wake.notified()).await;
            continue;
        };
        let _unfinished = Unfinished::begin(&node);
        let views = match both_views(&node, &peers, &mut ready, &candidate).await {
            Ok(Some(views)) => views,
            Ok(None) => {
                debug!(from = %candidate.pair.from, to = %candidate.pair.to, "nobody holds the evidence now; pending");
                node.lock().closer.put_off(&candidate.pair, node.now_s());
                continue;
            }
            Err(e) => {
                warn!(from = %candidate.pair.from, to = %candidate.pair.to, error = %format!("{e:#}"), "evidence can't be used");
                let message = format!("evidence can't be used: {e:#}");
                decide(
                    &node,
                    &candidate,
                    LoopOutcome::Rejected {
                        reason: "invalid_evidence".into(),
                        message,
                        numbers: BTreeMap::new(),
                    },
                );
                continue;
            }
        };
        let outcome = register(&node, views, &candidate).await;
        decide(&node, &candidate, outcome);
    }
}

fn decide(node: &Node, candidate: &Candidate, outcome: LoopOutcome) {
    match &outcome {
        LoopOutcome::Accepted { numbers, .. } => {
            info!(from = %candidate.pair.from, to = %candidate.pair.to, ?numbers, "loop accepted")
        }
        LoopOutcome::Rejected { message, .. } => {
            debug!(from = %candidate.pair.from, to = %candidate.pair.to, message, "loop rejected")
        }
    }
    let mut knowledge = node.lock();
    let payload = knowledge.closer.on_verified(candidate, outcome);
    if let Err(e) = knowledge.write(&payload) {
        warn!(error = %format!("{e:#}"), "a verdict could not be kept");
        return;
    }
    drop(knowledge);
    if let coma_slam::log::Payload::LoopVerdict(verdict) = &payload {
        let message = coma_wire::Wire::to_wire(verdict);
        node.publish(coma_wire::v1::watch_response::Event::Verdict(message));
    }
    node.entries_changed();
}

type Ready = Arc<Result<Prepared, Reason>>;

#[derive(Default)]
struct ReadyViews {
    order: VecDeque<SubmapId>,
    views: BTreeMap<SubmapId, Ready>,
}

impl ReadyViews {
    fn get(&self, id: &SubmapId) -> Option<Ready> {
        self.views.get(id).cloned()
    }

    fn put(&mut self, id: SubmapId, ready: Ready) {
        if self.order.len() >= READY_VIEWS
            && let Some(oldest) = self.order.pop_front()
        {
            self.views.remove(&oldest);
        }
        self.order.push_back(id.clone());
        self.views.insert(id, ready);
    }
}

/// Source (`to`) and target (`from`); `None` if nobody holds one of them.
async fn both_views(
    node: &Arc<Node>,
    peers: &Peers,
    ready: &mut ReadyViews,
    candidate: &Candidate,
) -> anyhow::Result<Option<(Ready, Ready)>> {
    let mut out = Vec::new();
    for (id, side) in [(&candidate.pair.to, Side::Source), (&candidate.pair.from, Side::Target)] {
        if let Some(view) = ready.get(id) {
            out.push(view);
            continue;
        }
        let name = node.lock().closer.submap(id).and_then(|facts| facts.anchor.as_ref().map(|a| a.full));
        let Some(name) = name else { return Ok(None) };
        let Some(blob) = fetch(node, peers, id, &name).await? else { return Ok(None) };
        let settings = node.config.registration.clone();
        let prepared = tokio::task::spawn_blocking(move || {
            let view = evidence::to_view(&name, blob)?;
            anyhow::Ok(Arc::new(Prepared::new(&view, &settings, side)))
        })
        .await??;
        ready.put(id.clone(), prepared.clone());
        out.push(prepared);
    }
    let target = out.pop();
    Ok(out.pop().zip(target))
}

async fn fetch(
    node: &Node,
    peers: &Peers,
    id: &SubmapId,
    name: &Evidence,
) -> anyhow::Result<Option<bytes::Bytes>> {
    if let Some(blob) = node.lock().journal.evidence(&name.hash)? {
        return Ok(Some(blob.into()));
    }
    let Some(blob) = peers.fetch_evidence(node, &id.agent, name).await else { return Ok(None) };
    node.lock().journal.put_evidence(&blob, false)?;
    Ok(Some(blob))
}

async fn register(node: &Node, views: (Ready, Ready), candidate: &Candidate) -> LoopOutcome {
    let settings = node.config.registration.clone();
    let text = format!("{}|{}", candidate.pair.from, candidate.pair.to);
    let hash = *blake3::hash(text.as_bytes()).as_bytes();
    let seed = u64::from_le_bytes(std::array::from_fn(|i| hash[i]));
    let registered = tokio::task::spawn_blocking(move || match (&*views.0, &*views.1) {
        (Ok(source), Ok(target)) => coma_registration::align::align_prepared(source, target, &settings, seed),
        (Err(reason), _) | (_, Err(reason)) => Outcome::Rejected(reason.clone()),
    })
    .await;
    match registered {
        Ok(outcome) => to_log(&outcome),
        Err(e) => LoopOutcome::Rejected {
            reason: "internal".into(),
            message: format!("registration failed: {e}"),
            numbers: BTreeMap::new(),
        },
    }
}

/// The verdict with all its numbers; for a yes the motion of `to` (source) in `from` (target).
fn to_log(outcome: &Outcome) -> LoopOutcome {
    match outcome {
        Outcome::Accepted(alignment) => LoopOutcome::Accepted {
            from_from_to: alignment.target_from_source,
            information: alignment.information,
            numbers: numbers(alignment).1,
        },
        Outcome::Rejected(reason) => {
            let (kind, numbers) = numbers(reason);
            LoopOutcome::Rejected { reason: kind, message: reason.to_string(), numbers }
        }
    }
}

/// The tag and the plain numbers of a serialised value.
fn numbers(value: &impl serde::Serialize) -> (String, BTreeMap<String, f64>) {
    let mut kind = String::new();
    let mut numbers = BTreeMap::new();
    if let Ok(serde_json::Value::Object(fields)) = serde_json::to_value(value) {
        for (name, value) in fields {
            match (name.as_str(), &value) {
                ("kind", serde_json::Value::String(text)) => kind = text.clone(),
                (_, serde_json::Value::Number(n)) => {
                    if let Some(n) = n.as_f64() {
                        numbers.insert(name, n);
                    }
                }
                _ => {}
            }
        }
    }
    (kind, numbers)
}
