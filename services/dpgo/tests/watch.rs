//! Corrections as they come: the present answer, every newer one, and an orderly end.

mod common;

use coma_dpgo::DpgoConfig;
use coma_wire::v1;
use coma_wire::v1::dpgo_client::DpgoClient;
use common::*;
use std::time::Duration;
use tonic::{Code, Streaming};

type Corrections = Streaming<v1::WatchCorrectionsResponse>;

async fn watch(client: &mut Client, graph: &str) -> Result<Corrections, tonic::Status> {
    let request = v1::WatchCorrectionsRequest { graph: graph.into() };
    Ok(client.watch_corrections(request).await?.into_inner())
}

async fn next(corrections: &mut Corrections) -> v1::SolveResponse {
    let next = tokio::time::timeout(Duration::from_secs(60), corrections.message()).await;
    next.expect("in time").expect("no end").expect("a message").answer.expect("an answer")
}

/// The largest cut of an answer's components, for each log.
fn used(answer: &v1::SolveResponse) -> u64 {
    let cuts = answer.components.iter().filter_map(|c| c.generation.as_ref()?.cut.as_ref());
    cuts.flat_map(|cut| cut.heads.iter().map(|h| h.length)).sum()
}

#[tokio::test]
async fn a_watcher_sees_the_present_answer_and_generations_rise_as_entries_enter() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (mut a, b) = team();
    put(&mut client, "g", all(&[&a, &b])).await;
    let mut corrections = watch(&mut client, "g").await.unwrap();
    let mut before = next(&mut corrections).await;
    assert_eq!(before, solved(&mut client, "g", &[&a, &b]).await, "the canonical answer");
    for n in [2, 4, 5, 7] {
        a.accept(submap("a", n), submap("b", n), 0.001);
        put(&mut client, "g", all(&[&a])).await;
        let after = next(&mut corrections).await;
        assert!(used(&after) > used(&before), "{} {}", used(&after), used(&before));
        assert_eq!(after, solved(&mut client, "g", &[&a, &b]).await);
        before = after;
    }
    // What changes no generation is not told: repetition, and a log that says nothing of loops.
    put(&mut client, "g", all(&[&a, &b])).await;
    put(&mut client, "g", all(&[&Log::walk("z", 100, 1)])).await;
    a.accept(submap("a", 0), submap("b", 0), 0.0);
    put(&mut client, "g", all(&[&a])).await;
    let after = next(&mut corrections).await;
    assert_eq!(after.components[0].loops.len(), before.components[0].loops.len() + 1);
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_watcher_skips_to_the_newest_and_holds_nobody_up() {
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (mut a, b) = (Log::walk("a", 100, 400), Log::walk("b", 100, 400));
    a.accept(submap("a", 1), submap("b", 1), 0.0);
    a.accept(submap("a", 90), submap("b", 90), 0.0);
    put(&mut client, "g", all(&[&a, &b])).await;
    // A reader whose windows hold less than one answer, and who does not read.
    let endpoint = tonic::transport::Endpoint::from_shared(handle.url.clone()).unwrap();
    let endpoint = endpoint.initial_stream_window_size(16_384).initial_connection_window_size(65_535);
    let mut narrow = DpgoClient::new(endpoint.connect().await.unwrap());
    let request = v1::WatchCorrectionsRequest { graph: "g".into() };
    let mut slow = narrow.watch_corrections(request).await.unwrap().into_inner();
    let mut quick = watch(&mut client, "g").await.unwrap();
    next(&mut quick).await;
    let changes = 12;
    let mut newest = v1::SolveResponse::default();
    for n in 0..changes {
        a.accept(submap("a", 100 + 7 * n), submap("b", 100 + 7 * n), 0.0);
        put(&mut client, "g", all(&[&a])).await;
        newest = next(&mut quick).await;
    }
    let mut seen = 0;
    while next(&mut slow).await != newest {
        seen += 1;
    }
    assert!(seen < changes, "{seen} answers before the newest: none was skipped");
    handle.shutdown().await;
}

#[tokio::test]
async fn watchers_are_bounded_and_one_that_leaves_makes_room() {
    let (handle, mut client) = start(DpgoConfig { max_watchers_per_graph: 2, ..Default::default() }).await;
    assert_eq!(watch(&mut client, "g").await.unwrap_err().code(), Code::NotFound);
    assert_eq!(watch(&mut client, "").await.unwrap_err().code(), Code::InvalidArgument);
    put(&mut client, "g", all(&[&team().0])).await;
    let (mut first, mut second) =
        (watch(&mut client, "g").await.unwrap(), watch(&mut client, "g").await.unwrap());
    next(&mut first).await;
    next(&mut second).await;
    let status = watch(&mut client, "g").await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted);
    assert!(status.message().contains("max_watchers_per_graph"), "{status}");
    drop(first);
    let again = async {
        loop {
            match watch(&mut client, "g").await {
                Ok(corrections) => return corrections,
                Err(_) => tokio::task::yield_now().await,
            }
        }
    };
    next(&mut tokio::time::timeout(Duration::from_secs(30), again).await.expect("room")).await;
    handle.shutdown().await;
}

#[tokio::test]
async fn a_watcher_ends_with_its_graph_and_with_the_service() {
    let mut config = DpgoConfig { max_graphs: 1, ..Default::default() };
    config.server.shutdown_grace_s = 60.0;
    let (handle, mut client) = start(config).await;
    put(&mut client, "x", all(&[&team().0])).await;
    let mut corrections = watch(&mut client, "x").await.unwrap();
    next(&mut corrections).await;
    put(&mut client, "y", all(&[&team().0])).await;
    let status = corrections.message().await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound, "{status}");
    assert!(status.message().contains("put the entries again"), "{status}");

    let mut corrections = watch(&mut client, "y").await.unwrap();
    next(&mut corrections).await;
    // Long before the grace time.
    let (ended, down) =
        tokio::join!(corrections.message(), tokio::time::timeout(Duration::from_secs(30), handle.shutdown()));
    assert_eq!(ended.unwrap_err().code(), Code::Unavailable);
    down.expect("nobody is waited for");
}
