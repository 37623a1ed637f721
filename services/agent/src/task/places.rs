//! Anchors are described, shared, indexed and looked up.

use crate::evidence;
use crate::node::{AnchorJob, Node, Unfinished};
use coma_frame::RgbdFrame;
use coma_geometry::SubmapId;
use coma_place::Descriptor;
use coma_runtime::Channel;
use coma_slam::log::{AnchorDescribed, Payload};
use coma_slam::loop_closure::{Candidate, Pair};
use coma_wire::v1::place_recognition_client::PlaceRecognitionClient;
use coma_wire::{At, Wire, v1};
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;
use tokio::sync::mpsc;
use tracing::{debug, warn};

/// How long to wait before a service that failed is asked again.
const RETRY: Duration = Duration::from_millis(500);
/// Anchors in one Insert.
const ANCHORS_PER_CALL: usize = 256;

type Client = PlaceRecognitionClient<Channel>;

/// Describes this agent's anchors as they come.
pub async fn describe(node: Arc<Node>, mut anchors: mpsc::Receiver<AnchorJob>, mut client: Client) {
    while let Some(job) = anchors.recv().await {
        if let Err(e) = describe_one(&node, &mut client, &job).await {
            warn!(submap = %job.submap, error = %format!("{e:#}"), "an anchor could not be described: its place can't be recognised");
        }
        node.unfinished.fetch_sub(1, Ordering::SeqCst);
        node.entries_changed();
    }
}

async fn describe_one(node: &Node, client: &mut Client, job: &AnchorJob) -> anyhow::Result<()> {
    let frame = job.frame.clone();
    let (evidence, request) = tokio::task::spawn_blocking(move || {
        anyhow::Ok((evidence::from_frame(&frame)?, describe_request(&frame)?))
    })
    .await??;
    {
        let mut knowledge = node.lock();
        knowledge.journal.put_evidence(&evidence.coarse.1, true)?;
        knowledge.journal.put_evidence(&evidence.full.1, true)?;
    }
    let mut tries = 0;
    let response = loop {
        match client.describe(request.clone()).await {
            Ok(response) => break response.into_inner(),
            Err(status) if tries < 20 => {
                tries += 1;
                debug!(%status, "place recognition did not describe an anchor yet");
                tokio::time::sleep(RETRY).await;
            }
            Err(status) => return Err(status.into()),
        }
    };
    let descriptors: Vec<Descriptor> = At::Root("descriptors").repeated(response.descriptors, 8)?;
    let described = AnchorDescribed {
        submap: job.submap.clone(),
        descriptors,
        coarse: evidence.coarse.0,
        full: evidence.full.0,
    };
    node.lock().write(&Payload::AnchorDescribed(described))?;
    Ok(())
}

fn describe_request(frame: &RgbdFrame) -> anyhow::Result<v1::DescribeRequest> {
    let mut color = Vec::new();
    JpegEncoder::new_with_quality(&mut color, 92).write_image(
        frame.color.pixels().as_flattened(),
        frame.camera.width,
        frame.camera.height,
        ExtendedColorType::Rgb8,
    )?;
    let depth = coma_depth_codec::encode(&frame.depth_m, &coma_depth_codec::Settings::default())?;
    Ok(v1::DescribeRequest {
        color_encoding: v1::ColorEncoding::Jpeg.into(),
        color: color.into(),
        depth: depth.into(),
        camera: Some(frame.camera.to_wire()),
    })
}

/// Keeps the index up with the logs, and looks up every new anchor, own or others'.
pub async fn index(node: Arc<Node>, mut client: Client) {
    loop {
        // Counted from before they are taken, so that a drain never sees neither.
        let unfinished = Unfinished::begin(&node);
        let (inserts, mut queries) = {
            let mut knowledge = node.lock();
            (knowledge.closer.take_inserts(), knowledge.closer.take_queries())
        };
        if inserts.is_empty() && queries.is_empty() {
            drop(unfinished);
            node.places_wake.notified().await;
            continue;
        }
        let without_room = match insert(&node, &mut client, &inserts).await {
            Ok(without_room) => without_room,
            Err(e) => {
                debug!(error = %format!("{e:#}"), "place recognition did not take anchors yet");
                node.lock().closer.retry(inserts, queries);
                tokio::time::sleep(RETRY).await;
                continue;
            }
        };
        // What is not in the index can't be looked up there, and would read as an index that started anew.
        queries.retain(|submap| !without_room.contains(submap));
        for (i, submap) in queries.iter().enumerate() {
            if let Err(e) = query(&node, &mut client, submap).await {
                debug!(error = %format!("{e:#}"), "place recognition did not answer a query yet");
                node.lock().closer.retry(Vec::new(), queries[i..].to_vec());
                if is_not_found(&e) {
                    node.lock().closer.insert_all_again();
                }
                tokio::time::sleep(RETRY).await;
                break;
            }
        }
        node.verify_wake.notify_one();
    }
}

/// The index or the anchor is gone: the service started anew.
fn is_not_found(error: &anyhow::Error) -> bool {
    error.downcast_ref::<tonic::Status>().is_some_and(|status| status.code() == tonic::Code::NotFound)
}

/// Gives anchors to place recognition; those that it has no room for come back, set aside.
async fn insert(node: &Node, client: &mut Client, submaps: &[SubmapId]) -> anyhow::Result<Vec<SubmapId>> {
    let (index, anchors) = {
        let knowledge = node.lock();
        let anchor = |id: &SubmapId| {
            let facts = knowledge.closer.submap(id)?;
            let anchor = facts.anchor.as_ref()?;
            Some(v1::Anchor {
                submap_id: Some(id.to_wire()),
                anchor_frame: facts.opened.anchor_frame,
                descriptors: anchor.descriptors.iter().map(Wire::to_wire).collect(),
            })
        };
        (knowledge.agent.to_string(), submaps.iter().filter_map(anchor).collect::<Vec<_>>())
    };
    let mut held = None;
    let mut without_room = Vec::new();
    let mut rest: &[v1::Anchor] = &anchors;
    let mut together = ANCHORS_PER_CALL;
    while !rest.is_empty() {
        let (chunk, after) = rest.split_at(together.min(rest.len()));
        let request = v1::InsertRequest { index: index.clone(), anchors: chunk.to_vec() };
        match client.insert(request).await {
            Ok(response) => {
                held = Some(response.into_inner().anchors_in_index);
                rest = after;
            }
            // All or none of a call: one by one, as many as there is room for.
            Err(status) if coma_wire::is_full(&status) && chunk.len() > 1 => together = 1,
            Err(status) if coma_wire::is_full(&status) => {
                without_room = set_aside(node, rest, status.message())?;
                break;
            }
            Err(status) => return Err(status.into()),
        }
    }
    let mut knowledge = node.lock();
    if held.is_some_and(|held| held < knowledge.closer.inserted() as u64) {
        debug!(held, "place recognition started anew: it is given all anchors again");
        knowledge.closer.insert_all_again();
    }
    Ok(without_room)
}

/// Place recognition has no room for these anchors: users are told, and the agent goes on without them.
fn set_aside(node: &Node, anchors: &[v1::Anchor], message: &str) -> anyhow::Result<Vec<SubmapId>> {
    let at = At::Root("anchors");
    let read = |a: &v1::Anchor| at.field("submap_id").required(a.submap_id.clone());
    let submaps = anchors.iter().map(read).collect::<Result<Vec<SubmapId>, _>>()?;
    warn!(
        anchors = submaps.len(),
        message, "place recognition has no room: these places can't be recognised"
    );
    let mut knowledge = node.lock();
    knowledge.closer.set_aside(submaps.clone());
    knowledge.warn_once(format!("{message}: new places are no longer recognised"));
    Ok(submaps)
}

async fn query(node: &Node, client: &mut Client, submap: &SubmapId) -> anyhow::Result<()> {
    let index = node.lock().agent.to_string();
    let limit = node.config.loops.candidates_per_anchor;
    let request = v1::QueryRequest { index, submap_id: Some(submap.to_wire()), limit };
    let response = client.query(request).await?.into_inner();
    let mut candidates = Vec::new();
    let at = At::Root("candidates");
    for (i, candidate) in response.candidates.into_iter().enumerate().take(limit as usize) {
        let at = at.index(i);
        let other: SubmapId = at.field("submap_id").required(candidate.submap_id)?;
        let Some(pair) = Pair::new(submap, &other) else { continue };
        candidates.push(Candidate {
            pair,
            similarity: candidate.similarity,
            window_similarity: candidate.window_similarity,
            space: candidate.space,
        });
    }
    let now_s = node.now_s();
    let mut knowledge = node.lock();
    for agent in response.agents_without_common_space {
        let text = format!("{agent} describes places in no space that this agent knows: no loops with it");
        knowledge.warn_once(text);
    }
    knowledge.closer.on_candidates(candidates, now_s);
    Ok(())
}

/// Asks which encoders run, and tells users.
pub async fn encoders(node: Arc<Node>, mut client: Client) {
    loop {
        match client.get_encoders(v1::GetEncodersRequest {}).await {
            Ok(response) => {
                let response = response.into_inner();
                let names: Vec<String> =
                    response.encoders.into_iter().map(|e| format!("{} ({})", e.name, e.space)).collect();
                let mut knowledge = node.lock();
                knowledge.encoder = names.join(", ");
                knowledge.warnings.extend(response.warnings);
                return;
            }
            Err(status) => {
                debug!(%status, "place recognition does not answer yet");
                tokio::time::sleep(RETRY).await;
            }
        }
    }
}
