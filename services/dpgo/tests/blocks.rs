//! Three dpgo services solve one graph block by block, over gRPC on this machine.

mod common;

use coma_dpgo::{BlockConfig, DpgoConfig, Handle, Server};
use coma_geometry::nalgebra::Vector3;
use coma_geometry::{Pose, SubmapId, se3};
use coma_pose_graph::blocks::BlockSettings;
use coma_pose_graph::residual::{residual, squared_mahalanobis};
use coma_runtime::{Bound, ByteLedger, ServerSettings, Services};
use coma_wire::entries::*;
use coma_wire::v1::dpgo_server::{Dpgo, DpgoServer};
use coma_wire::{At, FILE_DESCRIPTOR_SET, Wire, decode_payload, v1};
use common::*;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tonic::{Code, Request, Response, Status, Streaming};

const NAMES: [&str; 3] = ["a", "b", "c"];
const SUBMAPS: u32 = 12;

struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Nearly normal, within 1 cm and 0.3 degrees: what `information()` claims.
    fn error(&mut self) -> Pose {
        let mut normal = || (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0;
        let translation = Vector3::from_fn(|_, _| 0.01 * normal());
        Pose::new(translation, Vector3::from_fn(|_, _| 0.005 * normal()))
    }
}

/// What a graph's cost is made of.
#[derive(Clone)]
struct Measured {
    from: SubmapId,
    to: SubmapId,
    from_from_to: Pose,
    verdict: Option<EntryKey>,
}

/// Three agents; b has loops with both others, two of which are false.
struct Team {
    logs: BTreeMap<&'static str, Log>,
    measured: Vec<Measured>,
    false_loops: Vec<EntryKey>,
}

fn noisy_team(seed: u64) -> Team {
    let mut random = Random(seed);
    let mut team = Team { logs: BTreeMap::new(), measured: Vec::new(), false_loops: Vec::new() };
    for name in NAMES {
        let log = Log::walk_with(name, 100, SUBMAPS, || random.error());
        for entry in &log.entries {
            if let Ok(Payload::OdometryEdge(e)) = decode_payload(&entry.payload) {
                let (from, to, from_from_to) = (e.from, e.to, e.from_from_to);
                team.measured.push(Measured { from, to, from_from_to, verdict: None });
            }
        }
        team.logs.insert(name, log);
    }
    for n in (1..SUBMAPS).step_by(2) {
        let author = if n % 4 == 1 { "b" } else { "a" };
        // A loop's error is half of what it claims: none of the true ones is in doubt.
        let half = |error: Pose| se3::exp(&(se3::log(&error) * 0.5));
        team.accept(author, ("a", n), ("b", n), half(random.error()));
        team.accept("c", ("b", n), ("c", (n + 1) % SUBMAPS), half(random.error()));
    }
    let far = Pose::new(Vector3::new(1.5, -0.8, 0.4), Vector3::new(0.3, 1.0, 0.0));
    let wrong =
        [team.accept("b", ("a", 4), ("b", 10), far), team.accept("c", ("b", 3), ("c", 9), far.inverse())];
    team.false_loops.extend(wrong);
    team
}

impl Team {
    fn accept(&mut self, author: &str, from: (&str, u32), to: (&str, u32), error: Pose) -> EntryKey {
        let (from, to) = (submap(from.0, from.1), submap(to.0, to.1));
        let from_from_to = between(&from, &to) * error;
        let outcome =
            LoopOutcome::Accepted { from_from_to, information: information(), numbers: BTreeMap::new() };
        let (similarity, space) = (0.9, "builtin/1".into());
        let verdict = LoopVerdict { from: from.clone(), to: to.clone(), similarity, space, outcome };
        let key = self.logs.get_mut(author).unwrap().write(Payload::LoopVerdict(verdict));
        self.measured.push(Measured { from, to, from_from_to, verdict: Some(key.clone()) });
        key
    }

    /// The logs that an agent's dpgo needs: its own, and those of whom it has loops with.
    fn known_to(&self, name: &str) -> Vec<&Log> {
        let knows: &[&str] = match name {
            "a" => &["a", "b"],
            "c" => &["b", "c"],
            _ => &NAMES,
        };
        knows.iter().map(|n| &self.logs[n]).collect()
    }

    async fn central(&self) -> v1::Component {
        let (handle, mut client) = start(DpgoConfig::default()).await;
        let logs: Vec<&Log> = self.logs.values().collect();
        let mut answer = solved(&mut client, "all", &logs).await;
        handle.shutdown().await;
        assert_eq!(answer.components.len(), 1, "{:?}", answer.not_joined);
        answer.components.remove(0)
    }

    /// What poses cost under these weights.
    fn cost(&self, poses: &[v1::SubmapPose], loops: &[v1::LoopWeight]) -> f64 {
        let poses: BTreeMap<SubmapId, Pose> = poses.iter().map(read_pose).collect();
        let weights = weights(loops);
        let cost = |m: &Measured| {
            let weight = m.verdict.as_ref().map_or(1.0, |key| weights[key]);
            let error = residual(&poses[&m.from], &poses[&m.to], &m.from_from_to);
            0.5 * weight * squared_mahalanobis(&error, &information())
        };
        self.measured.iter().map(cost).sum()
    }
}

fn read_pose(pose: &v1::SubmapPose) -> (SubmapId, Pose) {
    let id = At::ROOT.required(pose.submap_id.clone()).unwrap();
    (id, At::ROOT.required(pose.map_from_submap).unwrap())
}

fn weights(loops: &[v1::LoopWeight]) -> BTreeMap<EntryKey, f64> {
    loops.iter().map(|l| (At::ROOT.required(l.verdict.clone()).unwrap(), l.weight)).collect()
}

fn config(step_ms: u64) -> DpgoConfig {
    // Somewhat more than what still means otherwise: enough for 0.1 % of the cost.
    let descent = BlockSettings { still_m: 3e-5, still_rad: 3e-6, ..Default::default() };
    let blocks = BlockConfig { enabled: true, step_ms, repeat_ms: 50, descent, ..Default::default() };
    DpgoConfig { blocks, ..Default::default() }
}

fn request(name: &str, addresses: &BTreeMap<&str, String>) -> v1::SolveBlockRequest {
    let others = addresses.iter().filter(|(other, _)| **other != name);
    v1::SolveBlockRequest {
        graph: name.into(),
        at_least: None,
        run: "r".into(),
        agent_id: name.into(),
        peers: others
            .map(|(other, address)| v1::BlockPeer {
                agent_id: (*other).to_owned(),
                dpgo_address: address.clone(),
            })
            .collect(),
        gauge: Some(submap("a", 0).to_wire()),
    }
}

type Blocks = Streaming<v1::SolveBlockResponse>;

async fn begin(client: &mut Client, team: &Team, name: &str, addresses: &BTreeMap<&str, String>) -> Blocks {
    put(client, name, all(&team.known_to(name))).await;
    client.solve_block(request(name, addresses)).await.expect("a block").into_inner()
}

async fn next(blocks: &mut Blocks) -> Result<v1::SolveBlockResponse, Status> {
    let next = tokio::time::timeout(Duration::from_secs(120), blocks.message()).await.expect("in time")?;
    next.ok_or_else(|| Status::unknown("it ended without a last message"))
}

async fn finish(mut blocks: Blocks) -> v1::SolveBlockResponse {
    loop {
        let told = next(&mut blocks).await.expect("progress");
        if told.finished {
            assert!(blocks.message().await.expect("an orderly end").is_none(), "it is the last message");
            return told;
        }
    }
}

struct Services3 {
    handles: BTreeMap<&'static str, Handle>,
    clients: BTreeMap<&'static str, Client>,
    addresses: BTreeMap<&'static str, String>,
}

impl Services3 {
    async fn start(step_ms: u64) -> Self {
        let (mut handles, mut clients, mut addresses) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        for name in NAMES {
            let (handle, client) = start(config(step_ms)).await;
            addresses.insert(name, handle.url.clone());
            handles.insert(name, handle);
            clients.insert(name, client);
        }
        Services3 { handles, clients, addresses }
    }

    async fn begin(&mut self, team: &Team) -> Vec<Blocks> {
        let mut out = Vec::new();
        for name in NAMES {
            out.push(begin(self.clients.get_mut(name).unwrap(), team, name, &self.addresses).await);
        }
        out
    }

    async fn shutdown(self) {
        for handle in self.handles.into_values() {
            handle.shutdown().await;
        }
    }
}

/// Costs add up to the central one, and the weights are the central ones.
async fn assert_reaches_the_central_result(team: &Team, last: &[v1::SolveBlockResponse]) {
    let central = team.central().await;
    let poses: Vec<v1::SubmapPose> = last.iter().flat_map(|l| l.provisional_poses.clone()).collect();
    let loops: Vec<v1::LoopWeight> = last.iter().flat_map(|l| l.loops.clone()).collect();
    assert_eq!(weights(&loops), weights(&central.loops));
    assert!(team.false_loops.iter().all(|key| weights(&loops)[key] == 0.0));
    assert_eq!(poses.len(), central.poses.len());
    assert!(last.iter().all(|l| l.unplaced == 0 && l.still && l.not_joined.is_empty()));
    let (cost, said) = (team.cost(&poses, &loops), last.iter().map(|l| l.cost).sum::<f64>());
    let steps: Vec<u64> = last.iter().map(|l| l.steps).collect();
    println!("cost {cost}, said to be {said}, central {}, steps {steps:?}", central.cost);
    assert!(cost <= 1.001 * central.cost, "{cost}, central {}", central.cost);
    assert!((said / cost - 1.0).abs() < 1e-3, "{said}, {cost}");
}

#[tokio::test(flavor = "multi_thread")]
async fn three_services_reach_the_cost_and_weights_of_one_that_holds_everything() {
    let team = noisy_team(1);
    let mut services = Services3::start(1).await;
    let blocks = services.begin(&team).await;
    let last = futures::future::join_all(blocks.into_iter().map(finish)).await;
    assert_reaches_the_central_result(&team, &last).await;
    services.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_starts_anew_in_the_middle_joins_again() {
    let team = noisy_team(2);
    let mut services = Services3::start(10).await;
    let mut blocks = services.begin(&team).await;
    let (mut of_c, mut of_b, mut of_a) =
        (blocks.pop().unwrap(), blocks.pop().unwrap(), blocks.pop().unwrap());
    // Everyone has found its place.
    for blocks in [&mut of_a, &mut of_b, &mut of_c] {
        while next(blocks).await.unwrap().unplaced > 0 {}
    }
    let listen = services.handles["b"].local_addr;
    services.handles.remove("b").unwrap().shutdown().await;
    let status = loop {
        match next(&mut of_b).await {
            Ok(told) => assert!(!told.finished, "the test is too slow: it was finished already"),
            Err(status) => break status,
        }
    };
    assert_eq!(status.code(), Code::Unavailable, "{status}");
    // The others see that it is away.
    let unheard = loop {
        let told = next(&mut of_a).await.unwrap();
        if let Some(unheard) = told.unheard.first() {
            break unheard.clone();
        }
    };
    assert_eq!(unheard.agent_id, "b");
    let mut fresh = config(10);
    fresh.server.listen = listen;
    services.handles.insert("b", Server::start(fresh).await.unwrap());
    let client = services.clients.get_mut("b").unwrap();
    // The channel connects anew.
    while client.put_entries(v1::PutEntriesRequest { graph: "b".into(), entries: vec![] }).await.is_err() {}
    let of_b = begin(client, &team, "b", &services.addresses).await;
    let last = futures::future::join_all([of_a, of_b, of_c].map(finish)).await;
    assert_reaches_the_central_result(&team, &last).await;
    services.shutdown().await;
}

/// A way to a dpgo that loses 30 % of all messages, or their answers, and delays the others.
#[derive(Clone)]
struct PoorWay {
    to: Client,
    random: Arc<Mutex<Random>>,
    lost: Arc<AtomicU64>,
}

#[tonic::async_trait]
impl Dpgo for PoorWay {
    type WatchCorrectionsStream = futures::stream::Empty<Result<v1::WatchCorrectionsResponse, Status>>;
    type SolveBlockStream = futures::stream::Empty<Result<v1::SolveBlockResponse, Status>>;

    async fn put_boundary(
        &self,
        request: Request<v1::PutBoundaryRequest>,
    ) -> Result<Response<v1::PutBoundaryResponse>, Status> {
        let random = || self.random.lock().unwrap().uniform();
        let (fate, delay, repeated) = (random(), random(), random() < 0.1);
        let (message, mut to) = (request.into_inner(), self.to.clone());
        let lost = || {
            self.lost.fetch_add(1, Ordering::Relaxed);
            Status::unavailable("lost on the way")
        };
        if fate < 0.2 {
            return Err(lost());
        }
        tokio::time::sleep(Duration::from_secs_f64(0.004 * delay)).await;
        if repeated {
            // Once more, and later than what comes next.
            let (message, mut to) = (message.clone(), self.to.clone());
            tokio::spawn(async move {
                tokio::time::sleep(Duration::from_millis(6)).await;
                let _ = to.put_boundary(message).await;
            });
        }
        let answer = to.put_boundary(message).await?;
        if fate < 0.3 { Err(lost()) } else { Ok(answer) }
    }

    async fn put_entries(
        &self,
        _: Request<v1::PutEntriesRequest>,
    ) -> Result<Response<v1::PutEntriesResponse>, Status> {
        Err(Status::unimplemented("only boundaries go this way"))
    }

    async fn solve(&self, _: Request<v1::SolveRequest>) -> Result<Response<v1::SolveResponse>, Status> {
        Err(Status::unimplemented("only boundaries go this way"))
    }

    async fn watch_corrections(
        &self,
        _: Request<v1::WatchCorrectionsRequest>,
    ) -> Result<Response<Self::WatchCorrectionsStream>, Status> {
        Err(Status::unimplemented("only boundaries go this way"))
    }

    async fn solve_block(
        &self,
        _: Request<v1::SolveBlockRequest>,
    ) -> Result<Response<Self::SolveBlockStream>, Status> {
        Err(Status::unimplemented("only boundaries go this way"))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_that_are_lost_late_or_repeated_cost_time_and_nothing_else() {
    let team = noisy_team(3);
    let mut services = Services3::start(1).await;
    let mut ways = Vec::new();
    for (k, name) in NAMES.iter().enumerate() {
        let way = PoorWay {
            to: services.clients[name].clone(),
            random: Arc::new(Mutex::new(Random(k as u64))),
            lost: Arc::default(),
        };
        let bound = Bound::bind(&ServerSettings::default()).await.unwrap();
        services.addresses.insert(name, bound.url());
        let server = DpgoServer::new(way.clone());
        let ledger = ByteLedger::default();
        let serving = bound.serve(Services::new().with(server), FILE_DESCRIPTOR_SET, &ledger).await;
        ways.push((way, serving.unwrap()));
    }
    let blocks = services.begin(&team).await;
    let last = futures::future::join_all(blocks.into_iter().map(finish)).await;
    assert_reaches_the_central_result(&team, &last).await;
    for (way, serving) in ways {
        assert!(way.lost.load(Ordering::Relaxed) > 10, "messages were lost");
        serving.shutdown().await;
    }
    services.shutdown().await;
}

#[tokio::test]
async fn bad_requests_for_a_block_are_refused_by_field_or_with_the_reason() {
    let team = noisy_team(4);
    let (handle, mut client) = start(config(5)).await;
    put(&mut client, "a", all(&team.known_to("a"))).await;
    let addresses: BTreeMap<&str, String> =
        NAMES.iter().map(|name| (*name, "http://127.0.0.1:9".to_owned())).collect();
    let with = |change: &dyn Fn(&mut v1::SolveBlockRequest)| {
        let mut request = request("a", &addresses);
        change(&mut request);
        request
    };
    let peer = |id: &str| v1::BlockPeer { agent_id: id.into(), dpgo_address: "http://x:1".into() };
    let cases: [(&str, v1::SolveBlockRequest); 11] = [
        ("graph", with(&|r| r.graph.clear())),
        ("run", with(&|r| r.run.clear())),
        ("run", with(&|r| r.run = "r".repeat(129))),
        ("agent_id", with(&|r| r.agent_id = "A B".into())),
        ("peers", with(&|r| r.peers = (0..1024).map(|k| peer(&format!("p{k}"))).collect())),
        ("peers[1].agent_id", with(&|r| r.peers[1] = r.peers[0].clone())),
        ("peers[2].agent_id", with(&|r| r.peers.push(peer("a")))),
        ("peers[0].dpgo_address", with(&|r| r.peers[0].dpgo_address = "x".repeat(513))),
        ("peers[0].dpgo_address", with(&|r| r.peers[0].dpgo_address = "ftp://b".into())),
        ("gauge", with(&|r| r.gauge = None)),
        ("gauge", with(&|r| r.gauge = Some(submap("stranger", 0).to_wire()))),
    ];
    for (field, request) in cases {
        assert_refused(client.solve_block(request).await, field);
    }
    let not_here = client.solve_block(with(&|r| r.graph = "other".into())).await.unwrap_err();
    assert_eq!(not_here.code(), Code::NotFound);
    for (change, reason) in [
        (&|r: &mut v1::SolveBlockRequest| r.at_least = Some(heads(&[&team.logs["c"]])) as _, "of c/1"),
        (
            &|r: &mut v1::SolveBlockRequest| {
                r.agent_id = "d".into();
                r.gauge = Some(submap("b", 0).to_wire());
            },
            "d has no submap",
        ),
        (&|r: &mut v1::SolveBlockRequest| r.gauge = Some(submap("a", 99).to_wire()), "gauge a/1/s99"),
        (&|r: &mut v1::SolveBlockRequest| drop(r.peers.remove(0)), "no loop to any of the others"),
    ] as [(&dyn Fn(&mut v1::SolveBlockRequest), &str); 4]
    {
        let status = client.solve_block(with(change)).await.unwrap_err();
        assert_eq!(status.code(), Code::FailedPrecondition, "{status}");
        assert!(status.message().contains(reason), "{status}");
    }
    handle.shutdown().await;
    // One that was not told to takes no part.
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let status = client.solve_block(request("a", &addresses)).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(status.message().contains("blocks.enabled"), "{status}");
    handle.shutdown().await;
}

/// What the fake neighbour b may say to a.
fn boundary(team: &[u8]) -> v1::PutBoundaryRequest {
    let part = v1::BlockPart {
        agent_ids: vec!["b".into()],
        open: vec!["a".into(), "c".into()],
        submaps: 9,
        low_m: vec![0.0; 3],
        high_m: vec![1.0; 3],
        largest_squared_error: 1.0,
        points: vec![0, 7],
        gradient: vec![0.5; 12],
        pairs: vec![0, 0, 0, 7, 7, 7],
        hessian: vec![1.0; 108],
    };
    let next = v1::BlockGrid { origin_m: vec![0.0; 3], spacing_m: 2.0, points: vec![2, 2, 2] };
    let field = v1::BlockField { motions: vec![0.0; 12], largest_squared_error: 1.0, next: Some(next) };
    v1::PutBoundaryRequest {
        run: "r".into(),
        from_agent_id: "b".into(),
        to_agent_id: "a".into(),
        team: team.to_vec().into(),
        life: 7,
        attempt: 0,
        boundary: Some(v1::Boundary {
            sequence: 1,
            poses: vec![v1::SubmapPose {
                submap_id: Some(submap("b", 1).to_wire()),
                map_from_submap: Some(Pose::identity().to_wire()),
            }],
            weights: vec![v1::BoundaryWeight {
                verdict: Some(v1::EntryKey { agent_id: "b".into(), epoch: 1, sequence: 3 }),
                weight: 1.0,
            }],
            root: "a".into(),
            depth: 1,
            below: true,
            part: Some(part),
            field: Some(field),
            ..Default::default()
        }),
        standings: vec![v1::Standing { agent_id: "b".into(), ..Default::default() }],
    }
}

#[tokio::test]
async fn garbage_from_a_neighbour_is_refused_by_field() {
    let team = noisy_team(5);
    let (handle, mut client) = start(config(5)).await;
    let addresses: BTreeMap<&str, String> =
        NAMES.iter().map(|name| (*name, "http://127.0.0.1:9".to_owned())).collect();
    let not_here = client.put_boundary(boundary(&[0; 32])).await.unwrap_err();
    assert_eq!(not_here.code(), Code::NotFound, "{not_here}");
    let mut running = begin(&mut client, &team, "a", &addresses).await;
    // A neighbour that does not answer is named.
    loop {
        let told = next(&mut running).await.unwrap();
        if let [unheard] = &told.unheard[..] {
            assert!(unheard.agent_id == "b" && !told.finished, "{told:?}");
            break;
        }
    }
    let other = client.put_boundary(boundary(&[0; 32])).await.unwrap_err();
    assert_eq!(other.code(), Code::FailedPrecondition, "{other}");
    assert!(other.message().contains("another team or gauge"), "{other}");
    // What all of this team are told alike.
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"a/1/s0\na\nb\nc");
    let digest = hasher.finalize();
    let with = |change: &dyn Fn(&mut v1::PutBoundaryRequest)| {
        let mut request = boundary(digest.as_bytes());
        change(&mut request);
        request
    };
    client.put_boundary(with(&|_| {})).await.expect("as it is it is taken");
    fn inner(r: &mut v1::PutBoundaryRequest) -> &mut v1::Boundary {
        r.boundary.as_mut().unwrap()
    }
    fn part(r: &mut v1::PutBoundaryRequest) -> &mut v1::BlockPart {
        inner(r).part.as_mut().unwrap()
    }
    fn field(r: &mut v1::PutBoundaryRequest) -> &mut v1::BlockField {
        inner(r).field.as_mut().unwrap()
    }
    fn next_grid(r: &mut v1::PutBoundaryRequest) -> &mut v1::BlockGrid {
        field(r).next.as_mut().unwrap()
    }
    let cases: Vec<(String, v1::PutBoundaryRequest)> = vec![
        ("run".into(), with(&|r| r.run = "r".repeat(129))),
        ("to_agent_id".into(), with(&|r| r.to_agent_id = "-".into())),
        ("from_agent_id".into(), with(&|r| r.from_agent_id = "d".into())),
        ("from_agent_id".into(), with(&|r| r.from_agent_id = "a".into())),
        ("team".into(), with(&|r| r.team = vec![1; 31].into())),
        ("attempt".into(), with(&|r| r.attempt = u64::MAX)),
        ("boundary.poses".into(), with(&|r| inner(r).poses = vec![v1::SubmapPose::default(); 65_537])),
        ("boundary.poses[0].submap_id".into(), with(&|r| inner(r).poses[0].submap_id = None)),
        (
            "boundary.poses[0].map_from_submap".into(),
            with(&|r| inner(r).poses[0].map_from_submap.as_mut().unwrap().qw = f64::NAN),
        ),
        ("boundary.weights[0].weight".into(), with(&|r| inner(r).weights[0].weight = 1.5)),
        ("boundary.weights[0].verdict".into(), with(&|r| inner(r).weights[0].verdict = None)),
        ("boundary.root".into(), with(&|r| inner(r).root = "d".into())),
        ("boundary.part.agent_ids[0]".into(), with(&|r| part(r).agent_ids[0].clear())),
        ("boundary.part.open".into(), with(&|r| part(r).open = vec!["c".into(); 4])),
        ("boundary.part.low_m".into(), with(&|r| part(r).low_m.truncate(2))),
        ("boundary.part.points".into(), with(&|r| part(r).points = vec![0; 4097])),
        ("boundary.part.gradient".into(), with(&|r| part(r).gradient.truncate(5))),
        ("boundary.part.pairs".into(), with(&|r| part(r).pairs.truncate(5))),
        ("boundary.part.hessian".into(), with(&|r| part(r).hessian.truncate(107))),
        ("boundary.part".into(), with(&|r| part(r).hessian[2] = f32::NAN)),
        ("boundary.part".into(), with(&|r| part(r).pairs.swap(2, 3))),
        ("boundary.field.motions".into(), with(&|r| field(r).motions.truncate(5))),
        ("boundary.field".into(), with(&|r| field(r).largest_squared_error = f64::INFINITY)),
        ("boundary.field.next".into(), with(&|r| field(r).next = None)),
        ("boundary.field.next.origin_m".into(), with(&|r| next_grid(r).origin_m.clear())),
        ("boundary.field.next.points".into(), with(&|r| next_grid(r).points.truncate(2))),
        ("boundary.field".into(), with(&|r| next_grid(r).points = vec![u32::MAX; 3])),
        ("standings[0].agent_id".into(), with(&|r| r.standings[0].agent_id = "d".into())),
        ("standings".into(), with(&|r| r.standings = vec![v1::Standing::default(); 4])),
    ];
    for (field, request) in cases {
        assert_refused(client.put_boundary(request).await, &field);
    }
    // Submaps and loops that are not known are left out: the neighbour may know more.
    let more = with(&|r| {
        inner(r).poses[0].submap_id = Some(submap("b", 999).to_wire());
        inner(r).weights[0].verdict.as_mut().unwrap().sequence = 999;
    });
    client.put_boundary(more).await.expect("taken");
    assert!(!next(&mut running).await.unwrap().finished);
    handle.shutdown().await;
}

#[tokio::test]
async fn a_newer_call_takes_over_a_caller_that_leaves_ends_its_run_and_runs_are_bounded() {
    let team = noisy_team(6);
    let mut limited = config(5);
    limited.blocks.max_runs = 1;
    let (handle, mut client) = start(limited).await;
    let addresses: BTreeMap<&str, String> =
        NAMES.iter().map(|name| (*name, "http://127.0.0.1:9".to_owned())).collect();
    let mut first = begin(&mut client, &team, "a", &addresses).await;
    next(&mut first).await.unwrap();
    let mut second = begin(&mut client, &team, "a", &addresses).await;
    let status = loop {
        match next(&mut first).await {
            Ok(told) => assert!(!told.finished),
            Err(status) => break status,
        }
    };
    assert_eq!(status.code(), Code::Aborted, "{status}");
    next(&mut second).await.unwrap();
    let other = v1::SolveBlockRequest { run: "other".into(), ..request("a", &addresses) };
    let status = client.solve_block(other.clone()).await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
    assert!(status.message().contains("blocks.max_runs"), "{status}");
    drop(second);
    let room = async { while client.solve_block(other.clone()).await.is_err() {} };
    tokio::time::timeout(Duration::from_secs(30), room).await.expect("the caller that left made room");
    handle.shutdown().await;
}
