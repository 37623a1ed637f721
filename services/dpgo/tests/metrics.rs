//! What a dpgo service counts. Alone in its process, since it reads the process's metrics.

mod common;

use coma_dpgo::{BlockConfig, DpgoConfig};
use coma_wire::{Wire, v1};
use common::*;
use std::time::Duration;

/// The value of a line of the metrics that begins with this.
fn value(name: &str) -> Option<f64> {
    let text = coma_runtime::metrics::render();
    text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.trim().parse().ok())
}

#[tokio::test(flavor = "multi_thread")]
async fn graphs_solves_generations_watchers_and_blocks_show_in_the_metrics() {
    coma_runtime::metrics::install();
    let blocks = BlockConfig { enabled: true, step_ms: 1, ..Default::default() };
    let (handle, mut client) = start(DpgoConfig { blocks, ..Default::default() }).await;
    let (mut a, mut b) = team();
    b.accept(submap("a", 5), submap("b", 5), 0.01);
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(value("coma_dpgo_graph_submaps"), Some(18.0));
    assert_eq!(value("coma_dpgo_graph_edges"), Some(16.0 + 5.0));
    assert_eq!(value("coma_dpgo_graph_components"), Some(1.0));
    assert_eq!(value("coma_dpgo_graph_cost"), Some(answer.components[0].cost));
    assert_eq!(value("coma_dpgo_generations_total"), Some(1.0));
    assert_eq!(value("coma_dpgo_solve_seconds_count"), Some(1.0));
    let request = v1::WatchCorrectionsRequest { graph: "g".into() };
    let mut watcher = client.watch_corrections(request).await.unwrap().into_inner();
    watcher.message().await.unwrap().unwrap();
    assert_eq!(value("coma_dpgo_watchers"), Some(1.0));
    assert_eq!(value("coma_dpgo_corrections_sent_total"), Some(1.0));
    a.accept(submap("a", 7), submap("b", 7), 0.0);
    solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(value("coma_dpgo_generations_total"), Some(2.0));

    // Two blocks in one service, which calls itself.
    let peer = |id: &str| v1::BlockPeer { agent_id: id.into(), dpgo_address: handle.url.clone() };
    let request = |own: &str, other: &str| v1::SolveBlockRequest {
        graph: "g".into(),
        at_least: None,
        run: "r".into(),
        agent_id: own.into(),
        peers: vec![peer(other)],
        gauge: Some(submap("a", 0).to_wire()),
    };
    let mut of_a = client.solve_block(request("a", "b")).await.unwrap().into_inner();
    let mut of_b = client.solve_block(request("b", "a")).await.unwrap().into_inner();
    let mut steps = 0;
    for blocks in [&mut of_a, &mut of_b] {
        let last = async {
            loop {
                let told = blocks.message().await.unwrap().expect("a last message");
                if told.finished {
                    return told;
                }
            }
        };
        steps += tokio::time::timeout(Duration::from_secs(60), last).await.expect("in time").steps;
    }
    assert_eq!(value("coma_dpgo_block_steps_total"), Some(steps as f64));
    assert!(value("coma_dpgo_boundary_messages_total").unwrap() > 2.0);
    assert!(value("coma_dpgo_boundary_bytes_total").unwrap() > 1000.0);
    drop(watcher);
    let idle = async {
        while value("coma_dpgo_block_runs") != Some(0.0) || value("coma_dpgo_watchers") != Some(0.0) {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(30), idle).await.expect("watchers and runs end");
    handle.shutdown().await;
}
