//! A graph that did not change is not solved again. Alone in its process, since it reads the process's metrics.

mod common;

use coma_dpgo::DpgoConfig;
use common::*;

fn counted(name: &str) -> u64 {
    let text = coma_runtime::metrics::render();
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.trim().parse().ok());
    line.unwrap_or(0)
}

#[tokio::test(flavor = "multi_thread")]
async fn one_state_of_a_graph_is_solved_once_however_often_it_is_asked_for() {
    coma_runtime::metrics::install();
    let (handle, mut client) = start(DpgoConfig::default()).await;
    let (mut a, b) = team();
    put(&mut client, "g", all(&[&a, &b])).await;
    let at_least = heads(&[&a, &b]);
    let asked: Vec<_> = (0..16)
        .map(|_| {
            let (mut client, request) = (client.clone(), solve_request("g", at_least.clone()));
            tokio::spawn(async move { client.solve(request).await.unwrap().into_inner() })
        })
        .collect();
    let mut answers = Vec::new();
    for one in asked {
        answers.push(one.await.unwrap());
    }
    assert!(answers.windows(2).all(|w| w[0] == w[1]));
    assert_eq!(counted("coma_dpgo_solves_total"), 1);
    // Entries that are known change nothing; nor does a new one that says nothing of the graph.
    a.write(coma_wire::entries::Payload::SolveDigest(digest()));
    put(&mut client, "g", all(&[&a, &b])).await;
    let answer = client.solve(solve_request("g", heads(&[&a, &b]))).await.unwrap().into_inner();
    assert_eq!(answer, answers[0]);
    assert_eq!(counted("coma_dpgo_solves_total"), 1);
    // One that does is seen.
    a.accept(submap("a", 4), submap("b", 4), 0.0);
    let answer = solved(&mut client, "g", &[&a, &b]).await;
    assert_eq!(answer.components[0].loops.len(), 5);
    assert_eq!(counted("coma_dpgo_solves_total"), 2);
    handle.shutdown().await;
}
