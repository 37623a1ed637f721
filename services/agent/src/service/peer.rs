//! What an agent serves to its peers.

use crate::node::Node;
use crate::task::peers::{BUILD, FEATURES};
use coma_runtime::{Class, Connection};
use coma_wire::Message;
use coma_wire::v1::peer_server::Peer;
use coma_wire::{At, PROTOCOL_MAJOR, PROTOCOL_MINOR, Wire, invalid, v1};
use futures::Stream;
use futures::stream;
use std::pin::Pin;
use std::sync::Arc;
use tonic::{Request, Response, Status};

/// Most entries in one answer.
const PULL_LIMIT: usize = 1000;

/// See `coma.v1.Peer`.
pub struct PeerService(pub Arc<Node>);

#[tonic::async_trait]
impl Peer for PeerService {
    async fn hello(&self, request: Request<v1::HelloRequest>) -> Result<Response<v1::HelloResponse>, Status> {
        let connection = Connection::of(&request);
        let hello = request.get_ref();
        let node = &self.0;
        if hello.protocol_major != PROTOCOL_MAJOR {
            return Err(Status::failed_precondition(format!(
                "protocol {}.{} is not spoken here: this agent (build {BUILD}) speaks {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}",
                hello.protocol_major, hello.protocol_minor
            )));
        }
        if hello.cluster_id != node.config.cluster_id {
            return Err(Status::failed_precondition(format!(
                "cluster {:?} is not this agent's cluster {:?}",
                hello.cluster_id.chars().take(80).collect::<String>(),
                node.config.cluster_id
            )));
        }
        coma_geometry::AgentId::from_wire(hello.agent_id.clone(), &At::Root("agent_id")).map_err(invalid)?;
        if let Some(connection) = connection {
            connection.check_name(&hello.agent_id).map_err(|e| Status::permission_denied(e.to_string()))?;
            connection.set_class(Class::Peer);
        }
        node.found_peer(&hello.endpoint);
        let knowledge = node.lock();
        Ok(Response::new(v1::HelloResponse {
            protocol_major: PROTOCOL_MAJOR,
            protocol_minor: PROTOCOL_MINOR,
            build: BUILD.into(),
            features: FEATURES.iter().map(|f| f.to_string()).collect(),
            agent_id: knowledge.agent.to_string(),
            epoch: knowledge.epoch.0,
            cluster_id: node.config.cluster_id.clone(),
            heads: Some(knowledge.replica.heads().to_wire()),
        }))
    }

    type PullEntriesStream = Pin<Box<dyn Stream<Item = Result<v1::PullEntriesResponse, Status>> + Send>>;

    async fn pull_entries(
        &self,
        request: Request<v1::PullEntriesRequest>,
    ) -> Result<Response<Self::PullEntriesStream>, Status> {
        let request = request.into_inner();
        let have = coma_wire::version_vector(request.have, &At::Root("have")).map_err(invalid)?;
        let limit = match request.limit {
            0 => PULL_LIMIT,
            n => (n as usize).min(PULL_LIMIT),
        };
        let knowledge = self.0.lock();
        let entries = knowledge.replica.missing(&have, limit);
        let mut messages: Vec<Result<v1::PullEntriesResponse, Status>> =
            entries.map(|e| Ok(v1::PullEntriesResponse { entry: Some(e.to_wire()), heads: None })).collect();
        let heads = Some(knowledge.replica.heads().to_wire());
        messages.push(Ok(v1::PullEntriesResponse { entry: None, heads }));
        Ok(Response::new(Box::pin(stream::iter(messages))))
    }

    async fn fetch_result(
        &self,
        request: Request<v1::FetchResultRequest>,
    ) -> Result<Response<v1::FetchResultResponse>, Status> {
        let wanted = request.into_inner().generation;
        let knowledge = self.0.lock();
        let found = knowledge.own_results.iter().find(|c| c.generation == wanted);
        let component =
            found.ok_or_else(|| Status::not_found("this is not a newest result of this agent"))?;
        Ok(Response::new(v1::FetchResultResponse { component: component.encode_to_vec().into() }))
    }

    async fn fetch_evidence(
        &self,
        request: Request<v1::FetchEvidenceRequest>,
    ) -> Result<Response<v1::FetchEvidenceResponse>, Status> {
        let hash = coma_wire::hash(&request.get_ref().hash, &At::Root("hash")).map_err(invalid)?;
        match self.0.lock().journal.evidence(&hash) {
            Ok(Some(blob)) => Ok(Response::new(v1::FetchEvidenceResponse { blob: blob.into() })),
            Ok(None) => Err(Status::not_found("this evidence is not held here")),
            Err(e) => Err(Status::data_loss(format!("evidence can't be read: {e:#}"))),
        }
    }
}
