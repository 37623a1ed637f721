//! What agents have at the end of a run, fetched over gRPC as any client could.

use crate::stream::plain;
use anyhow::{Context, bail};
use coma_geometry::{Pose, SubmapId};
use coma_runtime::{ByteLedger, Channel, Class, ClientSettings, channel};
use coma_surfel::SurfelCloud;
use coma_wire::v1::agent_client::AgentClient;
use coma_wire::v1::viewer_client::ViewerClient;
use coma_wire::{At, Limited, v1};
use std::time::{Duration, Instant};

/// Surfels that one submap may have.
const MAX_SURFELS: usize = 20_000_000;
/// How long a drain may go on without any progress.
const STUCK: Duration = Duration::from_secs(300);

/// One agent's clients.
#[derive(Clone)]
pub struct AgentCalls {
    agent: AgentClient<Channel>,
    viewer: ViewerClient<Channel>,
}

impl AgentCalls {
    /// Calls to the agent at `url`.
    pub fn new(url: &str, settings: &ClientSettings) -> anyhow::Result<Self> {
        let channel = channel(url, settings, &ByteLedger::default(), Class::Client)?;
        let limit = settings.max_message_bytes;
        Ok(AgentCalls {
            agent: AgentClient::new(channel.clone()).limited(limit),
            viewer: ViewerClient::new(channel).limited(limit),
        })
    }

    /// How it fares.
    pub async fn status(&mut self) -> anyhow::Result<v1::GetStatusResponse> {
        Ok(self.agent.get_status(v1::GetStatusRequest {}).await.map_err(plain)?.into_inner())
    }

    /// Every pose.
    pub async fn trajectory(&mut self) -> anyhow::Result<Vec<v1::PoseEstimate>> {
        let request = v1::GetTrajectoryRequest { first_sequence: 0 };
        let mut stream = self.viewer.get_trajectory(request).await.map_err(plain)?.into_inner();
        let mut poses = Vec::new();
        while let Some(message) = stream.message().await.map_err(plain)? {
            poses.extend(message.poses);
        }
        Ok(poses)
    }

    /// The graph as this agent sees it.
    pub async fn graph(&mut self) -> anyhow::Result<v1::GetGraphResponse> {
        Ok(self.viewer.get_graph(v1::GetGraphRequest {}).await.map_err(plain)?.into_inner())
    }

    /// Every submap with its surfels.
    pub async fn submaps(&mut self) -> anyhow::Result<Vec<Submap>> {
        let list = self.viewer.list_submaps(v1::ListSubmapsRequest {}).await.map_err(plain)?.into_inner();
        let mut out = Vec::new();
        for (i, info) in list.submaps.into_iter().enumerate() {
            let at = At::Root("submaps");
            let at = at.index(i);
            let id: SubmapId = at.field("id").required(info.id.clone())?;
            let Some(map_from_submap) = at.field("map_from_submap").optional(info.map_from_submap)? else {
                continue;
            };
            let request = v1::GetSubmapRequest { id: info.id };
            let mut stream = self.viewer.get_submap(request).await.map_err(plain)?.into_inner();
            let mut packed = Vec::new();
            while let Some(message) = stream.message().await.map_err(plain)? {
                packed.extend_from_slice(&message.chunk);
            }
            out.push(Submap { id, map_from_submap, packed });
        }
        Ok(out)
    }

    async fn drain(&mut self) -> anyhow::Result<v1::DrainResponse> {
        Ok(self.agent.drain(v1::DrainRequest {}).await.map_err(plain)?.into_inner())
    }
}

/// A submap as it is at the end.
pub struct Submap {
    /// Its name.
    pub id: SubmapId,
    /// Where it lies.
    pub map_from_submap: Pose,
    /// As [`coma_surfel::pack`] has them: a long run's surfels are many.
    packed: Vec<u8>,
}

impl Submap {
    /// Packed size.
    pub fn packed_bytes(&self) -> u64 {
        self.packed.len() as u64
    }

    /// Number of surfels.
    pub fn count(&self) -> anyhow::Result<usize> {
        coma_surfel::pack::count(&self.packed, MAX_SURFELS).with_context(|| format!("submap {}", self.id))
    }

    /// In its own frame.
    pub fn surfels(&self) -> anyhow::Result<SurfelCloud> {
        coma_surfel::pack::unpack(&self.packed, MAX_SURFELS).with_context(|| format!("submap {}", self.id))
    }
}

/// Waits until every candidate has a verdict, all logs are equal, and the graph is solved; `say` is told what is
/// still waited for.
pub async fn drain(agents: &mut [AgentCalls], mut say: impl FnMut(&str)) -> anyhow::Result<()> {
    let mut settled = 0;
    let (mut last, mut last_change) = (String::new(), Instant::now());
    while settled < 2 {
        let mut answers = Vec::new();
        for agent in agents.iter_mut() {
            answers.push(agent.drain().await?);
        }
        let equal = answers.windows(2).all(|pair| pair[0].heads == pair[1].heads);
        let done = equal && answers.iter().all(|a| a.drained);
        settled = if done { settled + 1 } else { 0 };
        let mut waiting: Vec<String> = answers.iter().flat_map(|a| a.waiting_for.iter().cloned()).collect();
        waiting.sort();
        waiting.dedup();
        let text = waiting.join("; ");
        if text != last {
            say(&text);
            (last, last_change) = (text, Instant::now());
        }
        if last_change.elapsed() > STUCK {
            bail!("the agents did not settle: still waiting for {last}");
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    Ok(())
}
