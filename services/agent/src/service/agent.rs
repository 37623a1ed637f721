//! What an agent serves to robots, phones and players.

use crate::convert;
use crate::decode;
use crate::node::Node;
use crate::queue::Job;
use crate::session::Session;
use crate::task::peers::BUILD;
use coma_wire::v1::agent_server::Agent;
use coma_wire::v1::stream_frames_response::Event;
use coma_wire::{At, Calibration, EncodedFrame, FieldError, Wire, invalid, v1};
use futures::Stream;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use tokio::sync::{broadcast, mpsc, oneshot};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

/// See `coma.v1.Agent`.
pub struct AgentService(pub Arc<Node>);

#[tonic::async_trait]
impl Agent for AgentService {
    async fn open_session(
        &self,
        request: Request<v1::OpenSessionRequest>,
    ) -> Result<Response<v1::OpenSessionResponse>, Status> {
        let node = &self.0;
        let request = request.into_inner();
        let at = At::Root("calibration");
        let calibration: Calibration = at.required(request.calibration).map_err(invalid)?;
        let policy = match v1::QueuePolicy::try_from(request.policy) {
            Ok(v1::QueuePolicy::Unspecified) => v1::QueuePolicy::Block,
            Ok(policy) => policy,
            Err(_) => {
                return Err(invalid(FieldError::new("policy", format!("{} is unknown", request.policy))));
            }
        };
        if v1::ClockDomain::try_from(request.clock_domain).is_err() {
            let message = format!("{} is unknown", request.clock_domain);
            return Err(invalid(FieldError::new("clock_domain", message)));
        }
        let id = if request.session_id.is_empty() {
            format!("session-{:x}", node.lock().frames)
        } else {
            coma_wire::session_id(&request.session_id, &At::Root("session_id")).map_err(invalid)?
        };
        let durable = node.lock().durable_of(&id);
        let mut open = node.session();
        let next_sequence = match open.as_mut() {
            Some(session) if session.id == id => {
                session.calibration = calibration;
                session.policy = policy;
                session.hold_out_every = request.hold_out_every;
                session.received.map_or(0, |(sequence, _)| sequence + 1)
            }
            Some(session) => {
                return Err(Status::failed_precondition(format!(
                    "session {} is open: an agent has one camera; close it first",
                    session.id
                )));
            }
            None => {
                *open = Some(Session {
                    id: id.clone(),
                    calibration,
                    policy,
                    hold_out_every: request.hold_out_every,
                    received: None,
                    processed: durable,
                    durable,
                    frames: 0,
                    dropped: 0,
                    step_budget: node.config.slam.mapping.steps_per_keyframe,
                });
                durable.map_or(0, |sequence| sequence + 1)
            }
        };
        drop(open);
        Ok(Response::new(v1::OpenSessionResponse {
            session_id: id,
            agent_id: node.lock().agent.to_string(),
            agent_endpoint: node.endpoint.clone(),
            max_frame_bytes: node.config.server.max_message_bytes as u64,
            next_sequence,
        }))
    }

    type StreamFramesStream = Pin<Box<dyn Stream<Item = Result<v1::StreamFramesResponse, Status>> + Send>>;

    async fn stream_frames(
        &self,
        request: Request<Streaming<v1::StreamFramesRequest>>,
    ) -> Result<Response<Self::StreamFramesStream>, Status> {
        let node = self.0.clone();
        let acks = node.acks();
        let (out, answers) = mpsc::channel(64);
        tokio::spawn(async move {
            let acking = tokio::spawn(forward_acks(acks, out.clone()));
            let end = take_frames(&node, request.into_inner(), &out).await;
            if let Err(status) = end {
                // The client may be gone already.
                let _ = out.send(Err(status)).await;
                acking.abort();
                return;
            }
            // The client has sent all: its acks go on until everything taken is processed.
            while node.session().as_ref().is_some_and(|s| s.received.map(|(r, _)| r) != s.processed)
                && !out.is_closed()
                && node.queue.pending() > 0
            {
                tokio::time::sleep(std::time::Duration::from_millis(20)).await;
            }
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
            acking.abort();
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }

    async fn close_session(
        &self,
        request: Request<v1::CloseSessionRequest>,
    ) -> Result<Response<v1::CloseSessionResponse>, Status> {
        let node = &self.0;
        let id =
            coma_wire::session_id(&request.get_ref().session_id, &At::Root("session_id")).map_err(invalid)?;
        let known = node.session().as_ref().is_some_and(|s| s.id == id);
        if known {
            let (reply, finished) = oneshot::channel();
            if !node.queue.push_waiting(Job::Finish(reply)).await {
                return Err(Status::unavailable("the agent is shutting down"));
            }
            finished.await.map_err(|_| Status::unavailable("the agent is shutting down"))?;
            node.session().take();
        } else if node.lock().durable_of(&id).is_none() {
            return Err(Status::not_found(format!("session {id} is not open here")));
        }
        let frames_processed = node.lock().frames;
        Ok(Response::new(v1::CloseSessionResponse { frames_processed }))
    }

    async fn get_status(
        &self,
        _request: Request<v1::GetStatusRequest>,
    ) -> Result<Response<v1::GetStatusResponse>, Status> {
        let node = &self.0;
        let bytes_sent = node.ledger.snapshot().into_iter().map(|s| v1::ByteCount {
            class: s.class.name().into(),
            message_type: s.message_type,
            bytes: s.bytes,
            messages: s.messages,
        });
        let bytes_sent = bytes_sent.collect();
        let knowledge = node.lock();
        let peers = knowledge.peers.iter().map(|(endpoint, p)| v1::PeerStatus {
            agent_id: p.agent.as_ref().map(|a| a.to_string()).unwrap_or_default(),
            endpoint: endpoint.clone(),
            alive: p.alive,
            last_error: p.last_error.clone(),
        });
        Ok(Response::new(v1::GetStatusResponse {
            agent_id: knowledge.agent.to_string(),
            epoch: knowledge.epoch.0,
            cluster_id: node.config.cluster_id.clone(),
            build: BUILD.into(),
            frames_processed: knowledge.frames,
            frames_dropped: knowledge.dropped,
            submaps: knowledge.submaps.len() as u32,
            surfels: knowledge.submaps.values().map(|s| s.surfels).sum(),
            state: convert::state(&knowledge.state).into(),
            heads: Some(knowledge.replica.heads().to_wire()),
            generation: knowledge.own_generation().map(convert::generation),
            peers: peers.collect(),
            stage_seconds: knowledge.stage_seconds.clone(),
            bytes_sent,
            encoder: knowledge.encoder.clone(),
            warnings: knowledge.warnings.clone(),
        }))
    }

    async fn drain(
        &self,
        _request: Request<v1::DrainRequest>,
    ) -> Result<Response<v1::DrainResponse>, Status> {
        let node = &self.0;
        let pending_frames = node.queue.pending() as u32;
        let knowledge = node.lock();
        let unfinished = node.unfinished.load(Ordering::SeqCst);
        let heads = knowledge.replica.heads();
        let pending_candidates = knowledge.closer.pending() as u32;
        let mut waiting_for = Vec::new();
        let mut wait = |what: bool, text: String| {
            if what {
                waiting_for.push(text);
            }
        };
        wait(pending_frames > 0, format!("{pending_frames} frames to be tracked and mapped"));
        wait(
            knowledge.closer.unqueried() > 0,
            format!("{} places to be looked up", knowledge.closer.unqueried()),
        );
        wait(pending_candidates > 0, format!("{pending_candidates} candidates to be verified"));
        wait(knowledge.closer.graph_changed(), "the graph to be solved".into());
        wait(unfinished > 0, format!("{unfinished} pieces of work under way"));
        for peer in knowledge.peers.values().filter(|p| p.alive && p.heads != heads) {
            if let Some(agent) = &peer.agent {
                wait(true, format!("the logs of {agent} to be equal"));
            }
        }
        Ok(Response::new(v1::DrainResponse {
            drained: waiting_for.is_empty(),
            pending_frames,
            pending_candidates,
            heads: Some(heads.to_wire()),
            generation: knowledge.own_generation().map(convert::generation),
            waiting_for,
        }))
    }
}

type Out = mpsc::Sender<Result<v1::StreamFramesResponse, Status>>;

/// Acks go to the client as they come; one that reads too slowly misses some, and the next says it all.
async fn forward_acks(mut acks: broadcast::Receiver<v1::FrameAck>, out: Out) {
    loop {
        let ack = match acks.recv().await {
            Ok(ack) => ack,
            Err(broadcast::error::RecvError::Lagged(_)) => continue,
            Err(broadcast::error::RecvError::Closed) => return,
        };
        if out.send(Ok(v1::StreamFramesResponse { event: Some(Event::Ack(ack)) })).await.is_err() {
            return;
        }
    }
}

/// Takes frames until the client ends its stream. A frame that can't be used is refused by name, and the
/// stream goes on.
async fn take_frames(
    node: &Arc<Node>,
    mut frames: Streaming<v1::StreamFramesRequest>,
    out: &Out,
) -> Result<(), Status> {
    while let Some(message) = frames.message().await? {
        let sequence = message.frame.as_ref().map_or(0, |f| f.sequence);
        match take_frame(node, message).await {
            Ok(()) => {}
            Err(Refused::Frame(error)) => {
                let refusal = v1::FrameRefusal { sequence, field: error.field, message: error.message };
                let event = Some(Event::Refusal(refusal));
                if out.send(Ok(v1::StreamFramesResponse { event })).await.is_err() {
                    return Ok(());
                }
            }
            Err(Refused::Stream(status)) => return Err(*status),
        }
    }
    Ok(())
}

enum Refused {
    Frame(FieldError),
    Stream(Box<Status>),
}

impl From<FieldError> for Refused {
    fn from(error: FieldError) -> Self {
        Refused::Frame(error)
    }
}

async fn take_frame(node: &Arc<Node>, message: v1::StreamFramesRequest) -> Result<(), Refused> {
    let stream = |status: Status| Refused::Stream(Box::new(status));
    let calibration = match node.session().as_ref() {
        Some(session) if session.id == message.session_id => session.calibration.clone(),
        _ => {
            let shown: String = message.session_id.chars().take(80).collect();
            return Err(stream(Status::not_found(format!("session {shown:?} is not open here"))));
        }
    };
    let at = At::Root("frame");
    let Some(frame) = message.frame else { return Err(at.refuse("is missing").into()) };
    let encoded = EncodedFrame::from_wire(frame, &calibration, &at)?;
    // Decoded before it is admitted: what can't be decoded leaves no gap in what was received.
    let decoded = tokio::task::spawn_blocking(move || decode::decode(&encoded, &calibration))
        .await
        .map_err(|e| stream(Status::internal(e.to_string())))??;
    let (map, policy, step_budget) = {
        let mut open = node.session();
        let Some(session) = open.as_mut() else {
            return Err(stream(Status::not_found("the session was closed")));
        };
        session.admit(decoded.sequence, decoded.stamp)?;
        (session.maps_this_frame(), session.policy, session.step_budget)
    };
    let job = Job::Frame { frame: Arc::new(decoded), map, step_budget };
    if policy == v1::QueuePolicy::Latest {
        let dropped = node.queue.push_dropping(job);
        let full = node.config.slam.mapping.steps_per_keyframe;
        if let Some(session) = node.session().as_mut() {
            session.adapt_budget(dropped, full);
        }
        node.lock().dropped += dropped;
    } else if !node.queue.push_waiting(job).await {
        return Err(stream(Status::unavailable("the agent is shutting down")));
    }
    Ok(())
}
