//! What agents are asked. Every call has a deadline to its end, and a limit on what is taken.

use super::link::{Link, plain};
use crate::cache::CachedSurfels;
use crate::error::ApiError;
use crate::json::{self, FramePose, Unreachable};
use coma_geometry::{AgentId, MapId, Pose, SubmapId};
use coma_wire::{At, FieldError, Wire, v1};
use futures::{StreamExt, stream};
use std::sync::Arc;
use tonic::Status;

/// Agents that are asked at the same time.
const AT_ONCE: usize = 16;

/// What those agents said that answered, by name, and which did not.
#[derive(Debug)]
pub struct Whole<T> {
    /// Sorted by name.
    pub answers: Vec<(AgentId, T)>,
    /// The others.
    pub unreachable: Vec<Unreachable>,
}

/// A submap, where it lies, and who has it.
#[derive(Clone, Debug)]
pub struct PlacedSubmap {
    /// Its name.
    pub id: SubmapId,
    /// Number of surfels.
    pub surfels: u64,
    /// No more frames come to it.
    pub closed: bool,
    /// Grows whenever its surfels change.
    pub revision: u64,
    /// By odometry alone.
    pub agent_from_submap: Pose,
    /// Where it lies.
    pub map_from_submap: Pose,
    /// In which map.
    pub map: MapId,
}

impl PlacedSubmap {
    /// Checked. A submap that no result places lies in its agent's own map.
    pub fn read(m: v1::SubmapInfo, at: &At<'_>) -> Result<Self, FieldError> {
        let id: SubmapId = at.field("id").required(m.id)?;
        let agent_from_submap = at.field("agent_from_submap").required(m.agent_from_submap)?;
        let map_from_submap: Option<Pose> = at.field("map_from_submap").optional(m.map_from_submap)?;
        let map: Option<MapId> = at.field("map_id").optional(m.map_id)?;
        Ok(PlacedSubmap {
            surfels: m.surfels,
            closed: m.closed,
            revision: m.revision,
            agent_from_submap,
            map_from_submap: map_from_submap.unwrap_or(agent_from_submap),
            map: map.unwrap_or_else(|| MapId { agent: id.agent.clone(), epoch: id.epoch, first_submap: 0 }),
            id,
        })
    }

    /// As callers see it.
    pub fn json(&self) -> json::Submap {
        json::Submap {
            id: self.id.to_string(),
            agent: self.id.agent.to_string(),
            surfels: self.surfels,
            closed: self.closed,
            revision: self.revision,
            agent_from_submap: (&self.agent_from_submap).into(),
            map_from_submap: (&self.map_from_submap).into(),
            map: self.map.to_string(),
        }
    }
}

impl Link {
    /// Its poses from a sequence on.
    pub async fn trajectory(&self, first_sequence: u64, max_poses: usize) -> Result<Vec<FramePose>, Status> {
        let call = async {
            let request = v1::GetTrajectoryRequest { first_sequence };
            let mut stream = self.viewer().get_trajectory(request).await?.into_inner();
            let mut poses = Vec::new();
            while let Some(message) = stream.message().await? {
                for pose in message.poses {
                    if poses.len() == max_poses {
                        return Err(Status::resource_exhausted(format!(
                            "more than {max_poses} poses: ask from a later first_sequence on"
                        )));
                    }
                    let at = At::Root("poses");
                    poses.push(FramePose::read(pose, &at.index(poses.len())).map_err(unreadable)?);
                }
            }
            Ok(poses)
        };
        self.in_time(call).await
    }

    /// Its submaps.
    pub async fn submaps(&self) -> Result<Vec<PlacedSubmap>, Status> {
        let call = async {
            let answer = self.viewer().list_submaps(v1::ListSubmapsRequest {}).await?.into_inner();
            let at = At::Root("submaps");
            let infos = answer.submaps.into_iter().enumerate();
            infos.map(|(i, info)| PlacedSubmap::read(info, &at.index(i)).map_err(unreadable)).collect()
        };
        self.in_time(call).await
    }

    /// One submap's surfels, as they were packed.
    pub async fn packed_surfels(&self, id: &SubmapId, max_surfels: usize) -> Result<CachedSurfels, Status> {
        let limit = coma_surfel::pack::packed_bytes(max_surfels);
        let call = async {
            let request = v1::GetSubmapRequest { id: Some(id.to_wire()) };
            let stream = self.viewer().get_submap(request).await?.into_inner();
            let (revision, packed) = coma_wire::packed_surfels(stream, id, limit).await?;
            Ok(CachedSurfels::new(revision, packed))
        };
        self.in_time(call).await
    }

    /// The graph as it sees it.
    pub async fn graph(&self) -> Result<v1::GetGraphResponse, Status> {
        let call = async { Ok(self.viewer().get_graph(v1::GetGraphRequest {}).await?.into_inner()) };
        self.in_time(call).await
    }

    async fn in_time<T>(&self, call: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
        let late = |_| Status::deadline_exceeded(format!("no whole answer within {:?}", self.call_timeout));
        tokio::time::timeout(self.call_timeout, call).await.map_err(late)?
    }
}

fn unreadable(error: FieldError) -> Status {
    Status::internal(format!("its answer can't be read: {error}"))
}

/// Asks all agents that answered their last status; the others are named.
pub async fn ask_all<T, F>(links: Vec<Arc<Link>>, ask: impl Fn(Arc<Link>) -> F) -> Whole<T>
where
    F: Future<Output = Result<T, Status>>,
{
    let asked = links.into_iter().map(|link| {
        let state = link.state();
        let answer = state.reachable.then(|| ask(link.clone()));
        async move {
            let unreachable = |error| Unreachable {
                id: state.id.as_ref().map(ToString::to_string),
                endpoint: link.endpoint.clone(),
                error,
            };
            match (answer, state.id.clone()) {
                (Some(answer), Some(id)) => match answer.await {
                    Ok(answer) => Ok((id, answer)),
                    Err(status) => Err(unreachable(plain(&status))),
                },
                _ => Err(unreachable(if state.asked { state.error.clone() } else { "not asked yet".into() })),
            }
        }
    });
    let mut answers: Vec<_> = stream::iter(asked).buffer_unordered(AT_ONCE).collect().await;
    let (mut here, mut gone) = (Vec::new(), Vec::new());
    answers.drain(..).for_each(|answer| match answer {
        Ok(answer) => here.push(answer),
        Err(unreachable) => gone.push(unreachable),
    });
    here.sort_by(|(a, _), (b, _)| a.cmp(b));
    gone.sort_by(|a, b| a.endpoint.cmp(&b.endpoint));
    Whole { answers: here, unreachable: gone }
}

/// What a caller is told when the one agent that it asked for did not answer.
pub fn failed(agent: &AgentId, status: &Status) -> ApiError {
    use tonic::Code;
    match status.code() {
        Code::NotFound => ApiError::not_found("id", plain(status)),
        Code::ResourceExhausted => ApiError::too_large("agent", plain(status)),
        _ => ApiError::agent(format!("agent {agent}: {}", plain(status))),
    }
}
