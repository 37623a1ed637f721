//! Agents find each other by gossip.

use coma_runtime::membership::Myself;
use coma_runtime::{ByteLedger, Class, Member, Membership, MembershipSettings};
use std::time::Duration;

async fn start(
    agent: &str,
    generation: u64,
    seeds: &[String],
    cluster: &str,
    ledger: &ByteLedger,
) -> Membership {
    let settings = MembershipSettings {
        cluster_id: cluster.into(),
        seeds: seeds.to_vec(),
        interval_s: 0.05,
        ..Default::default()
    };
    let myself =
        Myself { agent_id: agent.into(), epoch: 7, generation, endpoint: format!("http://{agent}:7000") };
    Membership::start(&settings, &myself, ledger).await.unwrap()
}

async fn until(membership: &Membership, what: &str, holds: impl Fn(&[Member]) -> bool) -> Vec<Member> {
    let mut members = membership.members();
    let found = tokio::time::timeout(Duration::from_secs(15), members.wait_for(|m| holds(m))).await;
    found.unwrap_or_else(|_| panic!("{what}: {:?}", membership.members().borrow())).unwrap().clone()
}

#[tokio::test]
async fn three_agents_find_each_other_and_miss_the_one_that_dies() {
    let ledger = ByteLedger::default();
    let a = start("a", 1, &[], "coma", &ledger).await;
    // A name that stands for an address is looked up.
    let seeds = [format!("localhost:{}", a.gossip_addr.port())];
    let b = start("b", 1, &seeds, "coma", &ledger).await;
    let c = start("c", 1, &seeds, "coma", &ledger).await;
    let elsewhere = start("x", 1, &seeds, "other-cluster", &ledger).await;

    let alive = |ids: &'static [&str]| {
        move |m: &[Member]| m.iter().filter(|m| m.alive).map(|m| &m.agent_id[..]).eq(ids.iter().copied())
    };
    until(&b, "b finds a and c", alive(&["a", "c"])).await;
    let seen = until(&a, "a finds b and c", alive(&["b", "c"])).await;
    assert_eq!(seen[0].endpoint, "http://b:7000");
    assert_eq!(seen[0].epoch, 7);

    c.set_log_length(42).await;
    until(&a, "a hears of c's log", |m| m.iter().any(|m| m.agent_id == "c" && m.log_length == 42)).await;

    drop(c);
    until(&a, "a misses c", alive(&["b"])).await;
    // It comes back, as a newer generation, on another port.
    let c = start("c", 2, &seeds, "coma", &ledger).await;
    until(&b, "b finds c again", alive(&["a", "c"])).await;

    assert!(elsewhere.members().borrow().is_empty(), "another cluster is not heard");
    let sent = ledger.snapshot();
    assert!(sent.len() == 1 && sent[0].class == Class::Gossip && sent[0].messages > 10, "{sent:?}");
    assert_eq!(sent[0].bytes, ledger.total(Class::Gossip));
    c.shutdown().await;
}

#[tokio::test]
async fn an_address_that_nobody_can_send_to_is_refused() {
    let settings = MembershipSettings { listen: "0.0.0.0:0".parse().unwrap(), ..Default::default() };
    let myself = Myself { agent_id: "a".into(), epoch: 1, generation: 1, endpoint: "http://a:1".into() };
    let error =
        Membership::start(&settings, &myself, &ByteLedger::default()).await.err().unwrap().to_string();
    assert!(error.contains("membership.advertise"), "{error}");
}
