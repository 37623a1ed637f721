//! What the scenarios are told with: who is there, what they see, and when all is done.

use coma_agent::AgentConfig;
use coma_dataset::world::{World, WorldSettings};
use coma_dataset::{ColorBytes, DepthBytes, Sequence};
use coma_dpgo::DpgoConfig;
use coma_geometry::{AgentId, Intrinsics, Pose, StampNs};
use coma_place_recognition::PlaceRecognitionConfig;
use coma_runtime::{ByteLedger, Channel, Class, channel};
use coma_wire::v1::agent_client::AgentClient;
use coma_wire::v1::dpgo_client::DpgoClient;
use coma_wire::v1::place_recognition_client::PlaceRecognitionClient;
use coma_wire::v1::stream_frames_response::Event;
use coma_wire::v1::viewer_client::ViewerClient;
use coma_wire::{At, Calibration, ColorData, DepthData, EncodedFrame, Limited, Wire, encode_frame, v1};
use std::sync::LazyLock;
use std::time::Duration;

/// Nothing that is waited for may take longer.
const PATIENCE: Duration = Duration::from_secs(240);
/// Largest message of the clients here.
const MAX_MESSAGE_BYTES: usize = 16 << 20;

static WORLD: LazyLock<World> = LazyLock::new(|| {
    World::new(WorldSettings { frames: 400, width: 240, height: 180, ..Default::default() })
        .expect("sound settings")
});

/// Where the camera of the walk is.
pub fn truth(frame: usize) -> Pose {
    WORLD.sequence(0).expect("a walk").truth(frame).expect("the world knows")
}

/// What it sees there: RGB, row by row.
pub fn picture(frame: usize) -> Vec<u8> {
    match WORLD.sequence(0).expect("a walk").frame(frame).expect("a frame").color {
        ColorBytes::Rgb8(image) => image.into_pixels().into_flattened(),
        _ => unreachable!("the built-in world films in RGB"),
    }
}

/// The camera itself.
pub fn camera() -> Intrinsics {
    WORLD.sequence(0).expect("a walk").calibration().color
}

/// A stretch of the built-in world's first walk.
#[derive(Clone, Copy)]
pub struct Walk {
    /// Where it begins.
    pub first_frame: usize,
    /// How long it is.
    pub frames: usize,
}

impl Walk {
    /// The stamp of its `index`-th frame.
    pub fn stamp(&self, index: usize) -> StampNs {
        WORLD.sequence(0).expect("a walk").stamp(self.first_frame + index)
    }

    /// What a session is told of the camera.
    pub fn calibration(&self) -> Calibration {
        let sequence = WORLD.sequence(0).expect("a walk");
        let known = sequence.calibration();
        let mut calibration = Calibration::registered(known.color, known.depth_units_per_metre);
        calibration.depth_noise = known.noise;
        calibration
    }

    /// A frame as it is streamed.
    pub fn message(&self, index: usize) -> v1::Frame {
        let sequence = WORLD.sequence(0).expect("a walk");
        let frame = sequence.frame(self.first_frame + index).expect("a frame");
        let color = match frame.color {
            ColorBytes::Rgb8(image) => ColorData::Rgb8(image.pixels().as_flattened().to_vec().into()),
            ColorBytes::Jpeg(bytes) => ColorData::Jpeg(bytes.into()),
            ColorBytes::Png(bytes) => ColorData::Png(bytes.into()),
        };
        let depth = match frame.depth {
            DepthBytes::Raw16(image) => {
                let bytes: Vec<u8> = image.pixels().iter().flat_map(|z| z.to_le_bytes()).collect();
                DepthData::Raw16(bytes.into())
            }
            DepthBytes::Png16(bytes) => DepthData::Png16(bytes.into()),
        };
        let stamp = sequence.stamp(self.first_frame + index);
        encode_frame(EncodedFrame { sequence: index as u64, stamp, color, depth })
    }
}

/// Agents with a place-recognition and a dpgo that they share, unless a scenario gives each its own.
pub struct Cast {
    agents: Vec<coma_agent::Handle>,
    channels: Vec<Channel>,
    place_recognition: coma_place_recognition::Handle,
    /// Those of the second agent and so on, where each has its own.
    more_place_recognition: Vec<coma_place_recognition::Handle>,
    dpgo: coma_dpgo::Handle,
    _data: tempfile::TempDir,
}

impl Cast {
    /// One agent for each name; each knows those before it.
    pub async fn start(names: &[&str]) -> Cast {
        Self::start_with_peers(names, &[]).await
    }

    /// The same, and all of them know these peers too.
    pub async fn start_with_peers(names: &[&str], peers: &[String]) -> Cast {
        Self::start_with(names, peers, vec![PlaceRecognitionConfig::default()], DpgoConfig::default()).await
    }

    /// The same, with these settings of the services: place-recognition is shared, or there is one for each agent.
    pub async fn start_with(
        names: &[&str],
        peers: &[String],
        places: Vec<PlaceRecognitionConfig>,
        dpgo: DpgoConfig,
    ) -> Cast {
        let mut started = Vec::new();
        for config in places {
            started.push(coma_place_recognition::Server::start(config).await.unwrap());
        }
        let more_place_recognition = started.split_off(1);
        let place_recognition = started.remove(0);
        let own: Vec<String> = more_place_recognition.iter().map(|handle| handle.url.clone()).collect();
        let place_of = |agent: usize| match agent.checked_sub(1).and_then(|more| own.get(more)) {
            Some(url) => url.clone(),
            None => place_recognition.url.clone(),
        };
        let dpgo = coma_dpgo::Server::start(dpgo).await.unwrap();
        let data = tempfile::tempdir().unwrap();
        let mut agents: Vec<coma_agent::Handle> = Vec::new();
        for name in names {
            let config = AgentConfig {
                agent_id: Some(AgentId::new(name).unwrap()),
                data: data.path().join(name),
                place_recognition: Some(place_of(agents.len())),
                dpgo: Some(dpgo.url.clone()),
                // Each greets those before it, and is followed back.
                peers: agents.iter().map(|a| a.url.clone()).chain(peers.iter().cloned()).collect(),
                gossip: false,
                ..AgentConfig::default()
            };
            agents.push(coma_agent::Server::start(config).await.unwrap());
        }
        let dial = |agent: &coma_agent::Handle| {
            channel(&agent.url, &Default::default(), &ByteLedger::default(), Class::Client).unwrap()
        };
        let channels = agents.iter().map(dial).collect();
        Cast { agents, channels, place_recognition, more_place_recognition, dpgo, _data: data }
    }

    /// Both services end, forget everything, and start anew at the same addresses.
    pub async fn restart_services(&mut self) {
        let mut config = PlaceRecognitionConfig::default();
        config.server.listen = self.place_recognition.local_addr;
        let fresh = coma_place_recognition::Server::start(PlaceRecognitionConfig::default()).await.unwrap();
        std::mem::replace(&mut self.place_recognition, fresh).shutdown().await;
        self.place_recognition = coma_place_recognition::Server::start(config).await.unwrap();
        let mut config = DpgoConfig::default();
        config.server.listen = self.dpgo.local_addr;
        let fresh = coma_dpgo::Server::start(DpgoConfig::default()).await.unwrap();
        std::mem::replace(&mut self.dpgo, fresh).shutdown().await;
        self.dpgo = coma_dpgo::Server::start(config).await.unwrap();
    }

    /// True if place recognition holds an anchor for this agent.
    pub async fn is_indexed(&self, agent: &str, submap_id: v1::SubmapId) -> bool {
        let request = v1::QueryRequest { index: agent.into(), submap_id: Some(submap_id), limit: 1 };
        let url = &self.place_recognition.url;
        let to_place = channel(url, &Default::default(), &ByteLedger::default(), Class::Local).unwrap();
        PlaceRecognitionClient::new(to_place).query(request).await.is_ok()
    }

    /// What dpgo makes of the entries that this agent's map was solved from. Later ones that change no graph (places
    /// described, pairs rejected) are given to dpgo with the next change, so they are not asked for.
    pub async fn solve(&self, index: usize) -> Result<v1::SolveResponse, tonic::Status> {
        let graph = self.agent(index).get_status(v1::GetStatusRequest {}).await?.into_inner().agent_id;
        let component = self.graph(index).await.components.swap_remove(0);
        let request = v1::SolveRequest { graph, at_least: component.generation.unwrap().cut };
        let url = &self.dpgo.url;
        let to_dpgo = channel(url, &Default::default(), &ByteLedger::default(), Class::Local).unwrap();
        Ok(DpgoClient::new(to_dpgo).solve(request).await?.into_inner())
    }

    /// What an agent tells its users.
    pub async fn warnings(&self, index: usize) -> Vec<String> {
        self.agent(index).get_status(v1::GetStatusRequest {}).await.unwrap().into_inner().warnings
    }

    /// This agent's submaps.
    pub async fn submaps(&self, index: usize) -> Vec<v1::SubmapInfo> {
        self.viewer(index).list_submaps(v1::ListSubmapsRequest {}).await.unwrap().into_inner().submaps
    }

    /// Where an agent serves.
    pub fn url(&self, index: usize) -> String {
        self.agents[index].url.clone()
    }

    /// Calls to an agent, as its clients make them.
    pub fn agent(&self, index: usize) -> AgentClient<Channel> {
        AgentClient::new(self.channels[index].clone()).limited(MAX_MESSAGE_BYTES)
    }

    fn viewer(&self, index: usize) -> ViewerClient<Channel> {
        ViewerClient::new(self.channels[index].clone()).limited(MAX_MESSAGE_BYTES)
    }

    /// Where the agents serve.
    pub fn urls(&self) -> Vec<String> {
        self.agents.iter().map(|agent| agent.url.clone()).collect()
    }

    /// Every agent gets its walk, at the same time; returns when all frames are processed.
    pub async fn stream(&self, walks: &[Walk]) {
        let played = walks.iter().enumerate().map(|(i, walk)| tokio::spawn(play(self.agent(i), *walk)));
        for one in played.collect::<Vec<_>>() {
            one.await.expect("the walk was played");
        }
    }

    /// Waits until nothing is left to do and all have equal logs and one result.
    pub async fn drained(&self) {
        let mut last = String::new();
        let all = async {
            loop {
                let mut answers = Vec::new();
                for index in 0..self.agents.len() {
                    answers.push(self.agent(index).drain(v1::DrainRequest {}).await.unwrap().into_inner());
                }
                let same = |a: &v1::DrainResponse| {
                    a.drained && a.heads == answers[0].heads && a.generation == answers[0].generation
                };
                if answers.iter().all(same) {
                    return;
                }
                last = format!("{:?}", answers.iter().map(|a| &a.waiting_for).collect::<Vec<_>>());
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        };
        if tokio::time::timeout(PATIENCE, all).await.is_err() {
            panic!("not drained after {PATIENCE:?}: {last}");
        }
    }

    /// The graph as an agent sees it.
    pub async fn graph(&self, index: usize) -> v1::GetGraphResponse {
        self.viewer(index).get_graph(v1::GetGraphRequest {}).await.unwrap().into_inner()
    }

    /// How many frames have a pose.
    pub async fn poses(&self, index: usize) -> usize {
        let request = v1::GetTrajectoryRequest { first_sequence: 0 };
        let mut answers = self.viewer(index).get_trajectory(request).await.unwrap().into_inner();
        let mut count = 0;
        while let Some(answer) = answers.message().await.unwrap() {
            count += answer.poses.len();
        }
        count
    }

    /// The trajectory in the map, frame by frame; frames without a pose in the map are left out.
    pub async fn map_from_camera(&self, index: usize) -> Vec<Pose> {
        let request = v1::GetTrajectoryRequest { first_sequence: 0 };
        let mut answers = self.viewer(index).get_trajectory(request).await.unwrap().into_inner();
        let mut poses = Vec::new();
        while let Some(answer) = answers.message().await.unwrap() {
            let placed = answer.poses.into_iter().filter(|p| p.generation.is_some());
            poses.extend(placed.map(|p| Pose::from_wire(p.map_from_camera.unwrap(), &At::ROOT).unwrap()));
        }
        poses
    }

    /// Ends all in order.
    pub async fn shutdown(self) {
        for agent in self.agents {
            agent.shutdown().await;
        }
        self.place_recognition.shutdown().await;
        for service in self.more_place_recognition {
            service.shutdown().await;
        }
        self.dpgo.shutdown().await;
    }
}

async fn play(mut client: AgentClient<Channel>, walk: Walk) {
    let request = v1::OpenSessionRequest {
        session_id: format!("walk-{}", walk.first_frame),
        calibration: Some(walk.calibration().to_wire()),
        policy: v1::QueuePolicy::Block.into(),
        clock_domain: v1::ClockDomain::Device.into(),
        hold_out_every: 0,
    };
    let session = client.open_session(request).await.unwrap().into_inner();
    assert_eq!(session.next_sequence, 0);
    let (send, frames) = tokio::sync::mpsc::channel(4);
    let session_id = session.session_id.clone();
    tokio::spawn(async move {
        for index in 0..walk.frames {
            let frame = tokio::task::spawn_blocking(move || walk.message(index)).await.unwrap();
            let message = v1::StreamFramesRequest { session_id: session_id.clone(), frame: Some(frame) };
            if send.send(message).await.is_err() {
                return;
            }
        }
    });
    let frames = tokio_stream::wrappers::ReceiverStream::new(frames);
    let mut events = client.stream_frames(frames).await.unwrap().into_inner();
    let mut processed = None;
    while let Some(message) = events.message().await.unwrap() {
        match message.event {
            Some(Event::Ack(ack)) => processed = ack.processed_through,
            Some(Event::Refusal(refusal)) => panic!("a frame was refused: {refusal:?}"),
            None => {}
        }
    }
    assert_eq!(processed, Some(walk.frames as u64 - 1), "every frame was acknowledged");
    client.close_session(v1::CloseSessionRequest { session_id: session.session_id }).await.unwrap();
}
