//! What agents have at the end of a run, fetched over gRPC as any client could.

use crate::stream::plain;
use anyhow::{Context, bail};
use coma_geometry::{Pose, StampNs, SubmapId};
use coma_runtime::{ByteLedger, Channel, Class, ClientSettings, channel};
use coma_surfel::{SurfelCloud, pack};
use coma_wire::v1::agent_client::AgentClient;
use coma_wire::v1::viewer_client::ViewerClient;
use coma_wire::{At, Limited, v1};
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom, Write as _};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Surfels that one submap may have.
const MAX_SURFELS: usize = 20_000_000;
/// Bytes of so many.
const MAX_PACKED_BYTES: usize = pack::packed_bytes(MAX_SURFELS);
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

    /// Every frame's pose.
    pub async fn trajectory(&mut self) -> anyhow::Result<Vec<FramePose>> {
        let request = v1::GetTrajectoryRequest { first_sequence: 0 };
        let mut stream = self.viewer.get_trajectory(request).await.map_err(plain)?.into_inner();
        let mut poses = Vec::new();
        while let Some(message) = stream.message().await.map_err(plain)? {
            for pose in message.poses {
                let at = At::Root("poses");
                let at = at.index(poses.len());
                poses.push(FramePose {
                    stamp: StampNs(pose.stamp_ns),
                    degraded: pose.state() == v1::TrackingState::Degraded,
                    submap: at.field("submap_id").required(pose.submap_id)?,
                    map_from_camera: at.field("map_from_camera").required(pose.map_from_camera)?,
                });
            }
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
        let spool = Arc::new(Spool::new()?);
        let mut out = Vec::new();
        for (i, info) in list.submaps.into_iter().enumerate() {
            let at = At::Root("submaps");
            let at = at.index(i);
            let id: SubmapId = at.field("id").required(info.id.clone())?;
            let Some(map_from_submap) = at.field("map_from_submap").optional(info.map_from_submap)? else {
                continue;
            };
            let request = v1::GetSubmapRequest { id: info.id };
            let stream = self.viewer.get_submap(request).await.map_err(plain)?.into_inner();
            let (_, packed) =
                coma_wire::packed_surfels(stream, &id, MAX_PACKED_BYTES).await.map_err(plain)?;
            let count = pack::count(&packed, MAX_SURFELS).with_context(|| format!("submap {id}"))?;
            let bytes = spool.put(&packed)?;
            out.push(Submap { id, map_from_submap, count, bytes, spool: spool.clone() });
        }
        Ok(out)
    }

    async fn drain(&mut self) -> anyhow::Result<v1::DrainResponse> {
        Ok(self.agent.drain(v1::DrainRequest {}).await.map_err(plain)?.into_inner())
    }
}

/// What is kept of a frame's estimate: a long run has many.
pub struct FramePose {
    /// The frame's own stamp.
    pub stamp: StampNs,
    /// Which submap it was tracked in.
    pub submap: SubmapId,
    /// As the graph has it.
    pub map_from_camera: Pose,
    /// Whether tracking was in doubt.
    pub degraded: bool,
}

/// A submap as it is at the end.
pub struct Submap {
    /// Its name.
    pub id: SubmapId,
    /// Where it lies.
    pub map_from_submap: Pose,
    /// Number of surfels.
    pub count: usize,
    bytes: Range<u64>,
    spool: Arc<Spool>,
}

impl Submap {
    /// Packed size.
    pub fn packed_bytes(&self) -> u64 {
        self.bytes.end - self.bytes.start
    }

    /// In its own frame.
    pub fn surfels(&self) -> anyhow::Result<SurfelCloud> {
        let packed = self.spool.get(&self.bytes)?;
        pack::unpack(&packed, MAX_SURFELS).with_context(|| format!("submap {}", self.id))
    }
}

/// Packed surfels, one submap after the other, in a file that goes when the last of them does: a long run has more than
/// memory should hold.
struct Spool(Mutex<File>);

impl Spool {
    fn new() -> anyhow::Result<Self> {
        Ok(Spool(Mutex::new(tempfile::tempfile().context("a temporary file for submaps")?)))
    }

    /// Where it lies from now on.
    fn put(&self, packed: &[u8]) -> anyhow::Result<Range<u64>> {
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let start = file.seek(SeekFrom::End(0))?;
        file.write_all(packed).context("writing a submap to a temporary file")?;
        Ok(start..start + packed.len() as u64)
    }

    fn get(&self, bytes: &Range<u64>) -> anyhow::Result<Vec<u8>> {
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(bytes.start))?;
        let mut packed = vec![0; (bytes.end - bytes.start) as usize];
        file.read_exact(&mut packed).context("reading a submap from a temporary file")?;
        Ok(packed)
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
