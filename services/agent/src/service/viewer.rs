//! What an agent shows of its work.

use crate::convert;
use crate::node::Node;
use coma_geometry::SubmapId;
use coma_slam::log::Payload;
use coma_wire::v1::viewer_server::Viewer;
use coma_wire::{At, Wire, invalid, v1};
use futures::{Stream, StreamExt, stream};
use std::pin::Pin;
use std::sync::Arc;
use tokio_stream::wrappers::BroadcastStream;
use tonic::{Request, Response, Status};

/// Poses in one message.
const POSES: usize = 256;
/// Bytes of surfels in one message.
const CHUNK: usize = 1 << 20;

/// See `coma.v1.Viewer`.
pub struct ViewerService(pub Arc<Node>);

type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

fn answers<T: Send + 'static>(messages: Vec<T>) -> Answers<T> {
    Box::pin(stream::iter(messages.into_iter().map(Ok)))
}

#[tonic::async_trait]
impl Viewer for ViewerService {
    type GetTrajectoryStream = Answers<v1::GetTrajectoryResponse>;

    async fn get_trajectory(
        &self,
        request: Request<v1::GetTrajectoryRequest>,
    ) -> Result<Response<Self::GetTrajectoryStream>, Status> {
        let first = request.get_ref().first_sequence;
        let knowledge = self.0.lock();
        let poses: Vec<_> = knowledge.trajectory.iter().filter(|p| p.pose.sequence >= first).collect();
        let message = |poses: &[&_]| v1::GetTrajectoryResponse {
            poses: poses.iter().map(|p| convert::pose_estimate(&knowledge, p)).collect(),
        };
        Ok(Response::new(answers(poses.chunks(POSES).map(message).collect())))
    }

    async fn list_submaps(
        &self,
        _request: Request<v1::ListSubmapsRequest>,
    ) -> Result<Response<v1::ListSubmapsResponse>, Status> {
        let knowledge = self.0.lock();
        let submaps =
            knowledge.submaps.keys().filter_map(|id| convert::submap_info(&knowledge, id)).collect();
        Ok(Response::new(v1::ListSubmapsResponse { submaps }))
    }

    type GetSubmapStream = Answers<v1::GetSubmapResponse>;

    async fn get_submap(
        &self,
        request: Request<v1::GetSubmapRequest>,
    ) -> Result<Response<Self::GetSubmapStream>, Status> {
        let at = At::Root("id");
        let id: SubmapId = at.required(request.into_inner().id).map_err(invalid)?;
        let node = self.0.clone();
        let read = move || -> Result<(u64, Vec<u8>), Status> {
            let mut knowledge = node.lock();
            let not_here = || Status::not_found(format!("submap {id} is not one of this agent's"));
            let own = knowledge.submaps.get(&id).cloned().ok_or_else(not_here)?;
            if let Some(blob) = own.blob {
                let packed = knowledge.journal.packed_surfels(&blob);
                return Ok((own.revision, packed.map_err(|e| Status::data_loss(format!("{e:#}")))?));
            }
            let active = knowledge.active.clone().filter(|(active, _)| *active == id);
            drop(knowledge);
            let (_, surfels) = active.ok_or_else(|| Status::unavailable("no surfels to show yet"))?;
            Ok((own.revision, coma_surfel::pack::pack(&surfels)))
        };
        let (revision, packed) =
            tokio::task::spawn_blocking(read).await.map_err(|e| Status::internal(e.to_string()))??;
        let packed = bytes::Bytes::from(packed);
        let messages = (0..packed.len().max(1))
            .step_by(CHUNK)
            .map(|from| v1::GetSubmapResponse {
                revision,
                chunk: packed.slice(from..(from + CHUNK).min(packed.len())),
            })
            .collect();
        Ok(Response::new(answers(messages)))
    }

    async fn get_graph(
        &self,
        _request: Request<v1::GetGraphRequest>,
    ) -> Result<Response<v1::GetGraphResponse>, Status> {
        let knowledge = self.0.lock();
        let mut entries = Vec::new();
        for entry in knowledge.replica.entries() {
            let mut message = entry.to_wire();
            // Descriptors would be most of it, and nobody draws them.
            if let Ok(Payload::AnchorDescribed(_)) = coma_wire::decode_payload(&entry.payload) {
                message.payload.clear();
            }
            entries.push(message);
        }
        Ok(Response::new(v1::GetGraphResponse {
            entries,
            components: knowledge.solved.components.clone(),
            not_joined: knowledge.solved.not_joined.clone(),
        }))
    }

    type WatchStream = Answers<v1::WatchResponse>;

    async fn watch(
        &self,
        _request: Request<v1::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let events = BroadcastStream::new(self.0.watch());
        // A watcher that was too slow lost events: it gets states again, as the contract says.
        let messages = events.map(|event| match event {
            Ok(event) => Ok(v1::WatchResponse { event: Some(event) }),
            Err(lagged) => Err(Status::data_loss(format!("watcher too slow: {lagged}; get states again"))),
        });
        Ok(Response::new(Box::pin(messages)))
    }
}
