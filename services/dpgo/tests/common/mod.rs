//! A small made-up world as the logs of two agents, and the service that solves it.
#![allow(dead_code, reason = "each test file uses its own part")]

use coma_dpgo::{DpgoConfig, Handle, Server};
use coma_geometry::{AgentId, Epoch, MapId, Matrix6, Pose, StampNs, SubmapId};
use coma_runtime::{ByteLedger, Channel, Class, channel};
use coma_wire::entries::*;
use coma_wire::v1::dpgo_client::DpgoClient;
use coma_wire::{At, Wire, encode_payload, field_errors_of, v1};
use std::collections::BTreeMap;
use tonic::{Code, Status};

pub type Client = DpgoClient<Channel>;

pub async fn start(config: DpgoConfig) -> (Handle, Client) {
    let handle = Server::start(config).await.expect("the service starts");
    let channel = channel(&handle.url, &Default::default(), &ByteLedger::default(), Class::Local).unwrap();
    (handle, DpgoClient::new(channel))
}

/// One agent's log.
pub struct Log {
    pub agent: AgentId,
    pub entries: Vec<Entry>,
}

pub fn submap(agent: &str, number: u32) -> SubmapId {
    SubmapId { agent: AgentId::new(agent).unwrap(), epoch: Epoch(1), number }
}

/// Where a submap is in the world: agents walk a circle of 4 m, b half a metre beside a and turned by 0.3 rad.
pub fn world_from_submap(id: &SubmapId) -> Pose {
    let turn = |angle: f64| Pose::new(coma_geometry::nalgebra::Vector3::zeros(), [0.0, angle, 0.0].into());
    let walk = |angle: f64| turn(angle) * Pose::translation(0.0, 0.0, 4.0);
    let along = walk(f64::from(id.number) * 0.3);
    if id.agent.as_str() == "a" { along } else { along * Pose::translation(0.5, 0.1, 0.0) * turn(0.3) }
}

pub fn between(from: &SubmapId, to: &SubmapId) -> Pose {
    world_from_submap(from).inv_mul(&world_from_submap(to))
}

pub fn information() -> Matrix6 {
    Matrix6::from_diagonal(&[1e4, 1e4, 1e4, 4e4, 4e4, 4e4].into())
}

impl Log {
    /// A log whose submaps are tied by exact odometry.
    pub fn walk(agent: &str, anchor_priority: u32, submaps: u32) -> Log {
        Log::walk_with(agent, anchor_priority, submaps, Pose::identity)
    }

    /// The same with odometry that has errors.
    pub fn walk_with(
        agent: &str,
        anchor_priority: u32,
        submaps: u32,
        mut error: impl FnMut() -> Pose,
    ) -> Log {
        let mut log = Log { agent: AgentId::new(agent).unwrap(), entries: Vec::new() };
        log.write(Payload::AgentStarted(AgentStarted { anchor_priority, build: "test".into() }));
        for number in 0..submaps {
            let id = submap(agent, number);
            log.write(Payload::SubmapOpened(SubmapOpened {
                id: id.clone(),
                anchor_frame: u64::from(number) * 25,
                anchor_stamp: StampNs(i64::from(number)),
                agent_from_submap: between(&submap(agent, 0), &id),
                chain: 0,
            }));
            if let Some(before) = number.checked_sub(1) {
                let from = submap(agent, before);
                let from_from_to = between(&from, &id) * error();
                let odometry = OdometryEdge { from_from_to, from, to: id, information: information() };
                log.write(Payload::OdometryEdge(odometry));
            }
        }
        log
    }

    pub fn write(&mut self, payload: Payload) -> EntryKey {
        self.write_bytes(encode_payload(&payload))
    }

    pub fn write_bytes(&mut self, payload: Vec<u8>) -> EntryKey {
        let sequence = self.entries.len() as u64;
        let key = EntryKey { agent: self.agent.clone(), epoch: Epoch(1), sequence };
        let previous_hash = self.entries.last().map(Entry::hash);
        self.entries.push(Entry { key: key.clone(), previous_hash, payload, signature: Vec::new() });
        key
    }

    /// A loop that holds, `off` metres beside the truth.
    pub fn accept(&mut self, from: SubmapId, to: SubmapId, off_m: f64) -> EntryKey {
        let from_from_to = between(&from, &to) * Pose::translation(off_m, 0.0, 0.0);
        let outcome =
            LoopOutcome::Accepted { from_from_to, information: information(), numbers: BTreeMap::new() };
        self.verdict(from, to, outcome)
    }

    /// A pair that is turned down.
    pub fn reject(&mut self, from: SubmapId, to: SubmapId) -> EntryKey {
        let (reason, message) = ("low_overlap".into(), "too little overlap".into());
        self.verdict(from, to, LoopOutcome::Rejected { reason, message, numbers: BTreeMap::new() })
    }

    fn verdict(&mut self, from: SubmapId, to: SubmapId, outcome: LoopOutcome) -> EntryKey {
        let space = "builtin/1".into();
        self.write(Payload::LoopVerdict(LoopVerdict { from, to, similarity: 0.9, space, outcome }))
    }

    pub fn withdraw(&mut self, verdict: EntryKey) -> EntryKey {
        self.write(Payload::LoopWithdrawn(LoopWithdrawn { verdict, message: "was wrong".into() }))
    }
}

/// Two agents with four loops between them, one of which a found and three b.
pub fn team() -> (Log, Log) {
    let (mut a, mut b) = (Log::walk("a", 100, 9), Log::walk("b", 100, 9));
    a.accept(submap("a", 1), submap("b", 1), 0.002);
    b.accept(submap("a", 3), submap("b", 3), -0.001);
    b.accept(submap("a", 6), submap("b", 6), 0.001);
    b.accept(submap("a", 8), submap("b", 8), 0.0);
    (a, b)
}

pub fn all(logs: &[&Log]) -> Vec<v1::Entry> {
    logs.iter().flat_map(|log| &log.entries).map(Wire::to_wire).collect()
}

pub fn heads(logs: &[&Log]) -> v1::VersionVector {
    let heads: VersionVector =
        logs.iter().map(|log| ((log.agent.clone(), Epoch(1)), log.entries.len() as u64)).collect();
    heads.to_wire()
}

pub async fn put(client: &mut Client, graph: &str, entries: Vec<v1::Entry>) -> VersionVector {
    let request = v1::PutEntriesRequest { graph: graph.into(), entries };
    let have = client.put_entries(request).await.expect("entries are taken").into_inner().have;
    coma_wire::version_vector(have, &At::Root("have")).unwrap()
}

pub fn solve_request(graph: &str, at_least: v1::VersionVector) -> v1::SolveRequest {
    v1::SolveRequest { graph: graph.into(), at_least: Some(at_least) }
}

#[track_caller]
pub fn assert_refused<T: std::fmt::Debug>(answer: Result<T, Status>, field: &str) {
    let status = answer.expect_err(field);
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    assert_eq!(field_errors_of(&status)[0].field, field, "{status}");
}

/// Puts whole logs and solves.
pub async fn solved(client: &mut Client, graph: &str, logs: &[&Log]) -> v1::SolveResponse {
    put(client, graph, all(logs)).await;
    client.solve(solve_request(graph, heads(logs))).await.expect("an answer").into_inner()
}

/// What a solver made of some cut.
pub fn digest() -> SolveDigest {
    let map_id = MapId { agent: AgentId::new("a").unwrap(), epoch: Epoch(1), first_submap: 0 };
    SolveDigest { map_id, cut: VersionVector::new(), digest: [0; 32] }
}
