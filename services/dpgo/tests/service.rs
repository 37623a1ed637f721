//! The service over gRPC: logs in, maps out, and what became of every loop.

mod common;

use coma_dpgo::{DpgoConfig, Server};
use coma_geometry::{Pose, SubmapId, se3};
use coma_runtime::{ByteLedger, Class, channel};
use coma_wire::entries::*;
use coma_wire::v1::dpgo_client::DpgoClient;
use coma_wire::{At, Wire, v1};
use common::*;
use tonic::Code;

fn pose_of(component: &v1::Component, id: &SubmapId) -> Pose {
    let found = component.poses.iter().find(|p| p.submap_id == Some(id.to_wire())).expect("a pose");
    Pose::from_wire(found.map_from_submap.unwrap(), &At::ROOT).unwrap()
}

#[tokio::test]
async fn two_agents_with_loops_between_them_get_one_map() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (a, b) = team();
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(answer.components.len(), 1, "{:?}", answer.not_joined);
    assert!(answer.not_joined.is_empty() && answer.rejected_entries.is_empty(), "{answer:?}");
    let component = &answer.components[0];
    assert_eq!(component.poses.len(), 18);
    for id in (0..9).flat_map(|n| [submap("a", n), submap("b", n)]) {
        let truth = between(&submap("a", 0), &id);
        let (metres, radians) = se3::distance(&pose_of(component, &id), &truth);
        assert!(metres < 0.003 && radians < 0.003, "{id}: {metres} m, {radians} rad");
    }
    assert_eq!(component.loops.len(), 4);
    assert!(component.loops.iter().all(|l| l.weight > 0.99 && l.message == "used"), "{:?}", component.loops);
    let generation = component.generation.as_ref().unwrap();
    let map_id = generation.map_id.as_ref().unwrap();
    assert_eq!((map_id.agent_id.as_str(), map_id.epoch), ("a", 1));
    assert_eq!(generation.digest.len(), 32);
    // The cut is a version vector: every loop is the last entry of its log here.
    assert_eq!(generation.cut, Some(heads(&[&a, &b])));
    handle.shutdown().await;
}

#[tokio::test]
async fn equal_entries_give_equal_bits_whatever_their_order_and_repetition() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (a, b) = team();
    let first = solved(&mut client, "straight", &[&a, &b]).await;
    // Alternating, three at a time, each piece twice and turned round, with solves in between.
    let mut pieces: Vec<Vec<v1::Entry>> = Vec::new();
    for (of_a, of_b) in a.entries.chunks(3).zip(b.entries.chunks(3)) {
        for piece in [of_b, of_a, of_b] {
            pieces.push(piece.iter().rev().map(Wire::to_wire).collect());
        }
    }
    pieces.push(all(&[&b]));
    pieces.push(all(&[&a]));
    for (i, piece) in pieces.into_iter().enumerate() {
        put(&mut client, "wild", piece).await;
        if i % 5 == 0 {
            client.solve(solve_request("wild", v1::VersionVector::default())).await.unwrap();
        }
    }
    let second = client.solve(solve_request("wild", heads(&[&a, &b]))).await.unwrap().into_inner();
    // Debug prints every bit of a float that matters, the sign of zero too.
    assert_eq!(format!("{first:?}"), format!("{second:?}"));
    // And another process of the same build.
    let (other, mut elsewhere) = start(DpgoConfig::default()).await;
    let third = solved(&mut elsewhere, "g", &[&b, &a]).await;
    assert_eq!(format!("{first:?}"), format!("{third:?}"));
    other.shutdown().await;
    handle.shutdown().await;
}

#[tokio::test]
async fn what_a_graph_lacks_is_said_and_a_gap_shows_in_have() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (a, b) = team();
    let nowhere = client.solve(solve_request("g", v1::VersionVector::default())).await.unwrap_err();
    assert_eq!(nowhere.code(), Code::NotFound);
    let mut entries = all(&[&a]);
    let missing = entries.remove(5);
    let have = put(&mut client, "g", entries).await;
    assert_eq!(have.values().copied().collect::<Vec<_>>(), [5]);
    let status = client.solve(solve_request("g", heads(&[&a]))).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    let needed = a.entries.len();
    assert!(
        status.message().contains(&format!("holds 5 entries of a/1, at_least asks for {needed}")),
        "{status}"
    );
    put(&mut client, "g", vec![missing]).await;
    let have = put(&mut client, "g", all(&[&a])).await;
    assert_eq!(have.to_wire(), heads(&[&a]));
    client.solve(solve_request("g", heads(&[&a]))).await.expect("now it holds enough");
    let status = client.solve(solve_request("g", heads(&[&a, &b]))).await.unwrap_err();
    assert!(status.message().contains("holds 0 entries of b/1"), "{status}");
    handle.shutdown().await;
}

#[tokio::test]
async fn a_service_that_starts_anew_is_given_the_entries_again() {
    let (a, b) = team();
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let listen = handle.local_addr;
    let before = solved(&mut client, "g", &[&a, &b]).await;
    handle.shutdown().await;
    let mut config = DpgoConfig::default();
    config.server.listen = listen;
    let handle = Server::start(config).await.unwrap();
    // The same channel, as an agent would hold it.
    let status = client.solve(solve_request("g", heads(&[&a, &b]))).await.unwrap_err();
    assert!([Code::NotFound, Code::Unavailable].contains(&status.code()), "{status}");
    assert_eq!(solved(&mut client, "g", &[&a, &b]).await, before);
    handle.shutdown().await;
}

#[tokio::test]
async fn agents_that_do_not_join_are_told_why() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (mut a, b, c) = (Log::walk("a", 100, 5), Log::walk("b", 100, 5), Log::walk("c", 100, 2));
    a.accept(submap("a", 1), submap("b", 1), 0.0);
    let answer = solved(&mut client, "g", &[&a, &b, &c]).await;
    assert_eq!(answer.components.len(), 3);
    let mut why: Vec<String> =
        answer.not_joined.iter().map(|n| format!("{} {}: {}", n.agent_a, n.agent_b, n.message)).collect();
    why.sort();
    assert_eq!(
        why,
        [
            "a b: 1 loop(s) between them, 2 are needed",
            "a c: no loop between them was accepted",
            "b c: no loop between them was accepted",
        ]
    );
    handle.shutdown().await;
}

#[tokio::test]
async fn the_smallest_anchor_priority_holds_the_gauge() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (a, mut b) = (Log::walk("a", 100, 9), Log::walk("b", 7, 9));
    for n in [1, 4, 8] {
        b.accept(submap("a", n), submap("b", n), 0.0);
    }
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    let generation = answer.components[0].generation.as_ref().unwrap();
    assert_eq!(generation.map_id.as_ref().unwrap().agent_id, "b");
    handle.shutdown().await;
}

#[tokio::test]
async fn of_double_verdicts_the_smallest_key_counts_and_a_withdrawal_brings_the_next_forward() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (mut a, mut b) = team();
    let pair = || (submap("a", 5), submap("b", 5));
    let refused = a.reject(pair().0, pair().1);
    let accepted = b.accept(pair().0, pair().1, 0.0);
    let weights = |answer: &v1::SolveResponse| answer.components[0].loops.len();
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(weights(&answer), 4);
    let rejected = &answer.rejected_entries[0];
    assert_eq!(rejected.key, Some(accepted.to_wire()));
    assert!(rejected.message.contains(&format!("a/1/{}", refused.sequence)), "{}", rejected.message);
    // The verdict that decided is in the cut.
    assert_eq!(answer.components[0].generation.as_ref().unwrap().cut, Some(heads(&[&a, &b])));

    // Only the author's word counts.
    b.withdraw(refused.clone());
    assert_eq!(weights(&solved(&mut client, "g", &[&a, &b]).await), 4);
    a.withdraw(refused);
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(weights(&answer), 5);

    let withdrawal = b.withdraw(accepted.clone());
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(weights(&answer), 4);
    let rejected = answer.rejected_entries.iter().find(|r| r.key == Some(accepted.to_wire())).unwrap();
    assert_eq!(rejected.message, format!("withdrawn by entry b/1/{}", withdrawal.sequence));
    handle.shutdown().await;
}

#[tokio::test]
async fn a_false_loop_is_left_out_with_its_error() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (a, mut b) = team();
    let wrong = b.accept(submap("a", 2), submap("b", 7), 1.5);
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    let component = &answer.components[0];
    let found = component.loops.iter().find(|l| l.verdict == Some(wrong.to_wire())).expect("it is shown");
    assert!(
        found.weight < 0.01 && found.squared_error > 100.0 && found.message.contains("contradicts"),
        "{found:?}"
    );
    let (metres, _) =
        se3::distance(&pose_of(component, &submap("b", 4)), &between(&submap("a", 0), &submap("b", 4)));
    assert!(metres < 0.003, "{metres}");
    handle.shutdown().await;
}

#[tokio::test]
async fn entries_that_cannot_be_used_are_named_and_the_log_goes_on() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (mut a, b) = team();
    let garbage = a.write_bytes(vec![0xff; 9]);
    let foreign = a.write(Payload::SubmapOpened(SubmapOpened {
        id: submap("b", 77),
        anchor_frame: 0,
        anchor_stamp: coma_geometry::StampNs(0),
        agent_from_submap: Pose::identity(),
        chain: 0,
    }));
    let nowhere = a.accept(submap("a", 1), submap("c", 1), 0.0);
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(answer.components.len(), 1);
    let reason = |key: &EntryKey| {
        let found = answer.rejected_entries.iter().find(|r| r.key == Some(key.to_wire()));
        found.unwrap_or_else(|| panic!("{key:?} is not named")).message.clone()
    };
    assert!(reason(&garbage).contains("is no Payload"), "{}", reason(&garbage));
    assert!(reason(&foreign).contains("submap b/1/s77 is not one of the life"), "{}", reason(&foreign));
    assert!(reason(&nowhere).contains("submap c/1/s1 is not known"), "{}", reason(&nowhere));
    handle.shutdown().await;
}

#[tokio::test]
async fn bad_requests_are_refused_by_field_and_take_nothing() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (a, _) = team();
    let with = |f: &dyn Fn(&mut v1::Entry)| {
        let mut entries = all(&[&a]);
        f(&mut entries[1]);
        v1::PutEntriesRequest { graph: "g".into(), entries }
    };
    let good = || with(&|_| {});
    let cases = [
        ("graph", v1::PutEntriesRequest { graph: String::new(), ..good() }),
        ("graph", v1::PutEntriesRequest { graph: "g".repeat(129), ..good() }),
        ("entries", v1::PutEntriesRequest { entries: vec![all(&[&a])[0].clone(); 4097], ..good() }),
        ("entries[1].key", with(&|e| e.key = None)),
        ("entries[1].key.agent_id", with(&|e| e.key.as_mut().unwrap().agent_id = "A B".into())),
        ("entries[1].previous_hash", with(&|e| e.previous_hash = vec![1; 31].into())),
        ("entries[1].payload", with(&|e| e.payload = vec![0; 257 * 1024].into())),
        ("entries[1].signature", with(&|e| e.signature = vec![0; 300].into())),
    ];
    for (field, request) in cases {
        assert_refused(client.put_entries(request).await, field);
    }
    assert_refused(client.solve(solve_request("", v1::VersionVector::default())).await, "graph");
    let head = v1::LogHead { agent_id: "-".into(), epoch: 0, length: 1 };
    let twice = v1::LogHead { agent_id: "a".into(), ..head.clone() };
    let at_least = v1::VersionVector { heads: vec![head] };
    assert_refused(client.solve(solve_request("g", at_least)).await, "at_least.heads[0].agent_id");
    let at_least = v1::VersionVector { heads: vec![twice.clone(), twice] };
    assert_refused(client.solve(solve_request("g", at_least)).await, "at_least.heads[1]");
    let status = client.solve(solve_request("g", v1::VersionVector::default())).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound, "nothing was taken: {status}");
    handle.shutdown().await;
}

#[tokio::test]
async fn graphs_are_bounded_and_the_least_recently_used_one_makes_room() {
    let config = DpgoConfig { max_graphs: 2, max_facts_per_graph: 12, ..Default::default() };
    let (handle, mut client) = start(config).await;
    let (a, _) = team();
    let request = v1::PutEntriesRequest { graph: "x".into(), entries: all(&[&a]) };
    let status = client.put_entries(request).await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted);
    assert!(coma_wire::is_full(&status), "waiting would not help: {status:?}");
    assert!(status.message().contains("max_facts_per_graph = 12"), "{status}");
    let short = Log::walk("a", 100, 3);
    for graph in ["x", "y"] {
        put(&mut client, graph, all(&[&short])).await;
    }
    client.solve(solve_request("x", v1::VersionVector::default())).await.unwrap();
    put(&mut client, "z", all(&[&short])).await;
    client.solve(solve_request("x", v1::VersionVector::default())).await.expect("x was used");
    let status = client.solve(solve_request("y", v1::VersionVector::default())).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
    handle.shutdown().await;
}

#[tokio::test]
async fn a_forked_log_is_not_used_from_there_on() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (a, b) = team();
    put(&mut client, "g", all(&[&a, &b])).await;
    // The last entry of a, which is a loop, in another version.
    let mut other = team().0;
    other.entries.pop();
    other.accept(submap("a", 1), submap("b", 1), 0.5);
    let have = put(&mut client, "g", all(&[&other])).await;
    let fork = a.entries.len() as u64 - 1;
    assert_eq!(have.get(&(a.agent.clone(), coma_geometry::Epoch(1))), Some(&fork));
    let status = client.solve(solve_request("g", heads(&[&a, &b]))).await.unwrap_err();
    assert!(status.message().contains(&format!("forked at {fork}")), "{status}");
    let answer = client.solve(solve_request("g", have.to_wire())).await.unwrap().into_inner();
    assert_eq!(answer.components[0].loops.len(), 3);
    assert!(answer.rejected_entries[0].message.contains("two different entries"));
    handle.shutdown().await;
}

#[tokio::test]
async fn health_tells_who_serves_and_shutdown_ends_it() {
    let (handle, _) = start(DpgoConfig::default()).await;
    let url = handle.url.clone();
    let channel = || channel(&url, &Default::default(), &ByteLedger::default(), Class::Local).unwrap();
    let mut health = tonic_health::pb::health_client::HealthClient::new(channel());
    let check = tonic_health::pb::HealthCheckRequest { service: "coma.v1.Dpgo".into() };
    assert_eq!(health.check(check).await.unwrap().into_inner().status, 1);
    handle.shutdown().await;
    let gone = DpgoClient::new(channel()).solve(solve_request("g", v1::VersionVector::default())).await;
    assert_eq!(gone.unwrap_err().code(), Code::Unavailable);
}
