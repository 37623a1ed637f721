use super::*;
use coma_geometry::{Epoch, Matrix6, Pose, StampNs};

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn submap(name: &str, number: u32) -> SubmapId {
    SubmapId { agent: agent(name), epoch: Epoch(1), number }
}

fn key(name: &str, sequence: u64) -> EntryKey {
    EntryKey { agent: agent(name), epoch: Epoch(1), sequence }
}

fn closer_with(submaps: &[SubmapId]) -> LoopCloser {
    let mut closer = LoopCloser::new(agent("a"), LoopSettings::default());
    for (i, id) in submaps.iter().enumerate() {
        let opened = SubmapOpened {
            id: id.clone(),
            anchor_frame: 20 * i as u64,
            anchor_stamp: StampNs(0),
            agent_from_submap: Pose::identity(),
            chain: 0,
        };
        closer.on_entry(&key(id.agent.as_str(), i as u64), &Payload::SubmapOpened(opened));
    }
    closer
}

fn candidate(x: &SubmapId, y: &SubmapId, score: f32) -> Candidate {
    Candidate {
        pair: Pair::new(x, y).unwrap(),
        similarity: score,
        window_similarity: score,
        space: "builtin/1".into(),
    }
}

fn rejected() -> LoopOutcome {
    LoopOutcome::Rejected { reason: "low_overlap".into(), message: "little".into(), numbers: BTreeMap::new() }
}

fn accepted() -> LoopOutcome {
    LoopOutcome::Accepted {
        from_from_to: Pose::identity(),
        information: Matrix6::identity(),
        numbers: BTreeMap::new(),
    }
}

#[test]
fn a_pair_with_a_verdict_is_never_tried_again() {
    let (x, y) = (submap("a", 0), submap("a", 5));
    let mut closer = closer_with(&[x.clone(), y.clone()]);
    closer.on_candidates(vec![candidate(&x, &y, 0.9)], 0.0);
    let found = closer.next_to_verify(|_| true, 0.0).unwrap();
    assert!(closer.next_to_verify(|_| true, 0.0).is_none(), "it is in work");
    let verdict = closer.on_verified(&found, rejected());
    closer.on_entry(&key("a", 7), &verdict);
    assert_eq!(closer.pending(), 0);
    closer.on_candidates(vec![candidate(&x, &y, 0.95)], 1.0);
    assert_eq!(closer.pending(), 0);
}

#[test]
fn exactly_one_end_verifies_and_the_other_takes_over_in_time() {
    let (x, y) = (submap("a", 0), submap("b", 0));
    let pair = Pair::new(&x, &y).unwrap();
    let verifier = pair.verifier(|_| true).unwrap();
    let other = if verifier == agent("a") { agent("b") } else { agent("a") };
    let mut closer = LoopCloser { own: other, ..closer_with(&[x.clone(), y.clone()]) };
    closer.on_candidates(vec![candidate(&x, &y, 0.9)], 0.0);
    assert!(closer.next_to_verify(|_| true, 9.0).is_none());
    assert!(closer.next_to_verify(|_| true, 10.5).is_some());
}

#[test]
fn a_dead_verifier_is_replaced_at_once() {
    let pair = Pair::new(&submap("a", 0), &submap("b", 0)).unwrap();
    assert_eq!(pair.verifier(|agent| agent.as_str() == "a"), Some(agent("a")));
    assert_eq!(pair.verifier(|agent| agent.as_str() == "b"), Some(agent("b")));
}

#[test]
fn agents_that_are_not_tied_come_first() {
    let ids = [submap("a", 0), submap("a", 9), submap("b", 0)];
    let mut closer = closer_with(&ids);
    let within = candidate(&ids[0], &ids[1], 0.99);
    let between = candidate(&ids[0], &ids[2], 0.7);
    for n in 0..3 {
        let done = LoopVerdict {
            from: submap("a", 20 + n),
            to: submap("a", 40 + n),
            similarity: 1.0,
            space: "builtin/1".into(),
            outcome: accepted(),
        };
        closer.on_entry(&key("a", 50 + n as u64), &Payload::LoopVerdict(done));
    }
    closer.on_candidates(vec![within, between.clone()], 0.0);
    assert_eq!(closer.next_to_verify(|a| a.as_str() == "a", 0.0), Some(between));
}

#[test]
fn evidence_that_nobody_holds_is_asked_for_again_later() {
    let (x, y) = (submap("a", 0), submap("a", 5));
    let mut closer = closer_with(&[x.clone(), y.clone()]);
    closer.on_candidates(vec![candidate(&x, &y, 0.9)], 0.0);
    let found = closer.next_to_verify(|_| true, 0.0).unwrap();
    closer.put_off(&found.pair, 0.0);
    assert!(closer.next_to_verify(|_| true, 1.0).is_none());
    assert!(closer.next_to_verify(|_| true, 6.0).is_some());
}

#[test]
fn double_verdicts_are_harmless_the_smallest_key_counts() {
    let (x, y) = (submap("a", 0), submap("b", 5));
    let mut closer = closer_with(&[x.clone(), y.clone()]);
    let verdict = |outcome| {
        Payload::LoopVerdict(LoopVerdict {
            from: x.clone(),
            to: y.clone(),
            similarity: 0.5,
            space: "builtin/1".into(),
            outcome,
        })
    };
    closer.on_entry(&key("b", 3), &verdict(rejected()));
    closer.on_entry(&key("a", 9), &verdict(accepted()));
    let decided: Vec<_> = closer.decided().collect();
    assert_eq!(decided.len(), 1);
    assert_eq!(decided[0].1, &key("a", 9));
}

#[test]
fn only_an_author_withdraws_its_verdict() {
    let (x, y) = (submap("a", 0), submap("b", 5));
    let mut closer = closer_with(&[x.clone(), y.clone()]);
    let verdict = LoopVerdict { from: x, to: y, similarity: 0.5, space: "s".into(), outcome: accepted() };
    closer.on_entry(&key("a", 9), &Payload::LoopVerdict(verdict));
    let withdraw = crate::log::LoopWithdrawn { verdict: key("a", 9), message: "wrong".into() };
    closer.on_entry(&key("b", 4), &Payload::LoopWithdrawn(withdraw.clone()));
    assert_eq!(closer.decided().count(), 1);
    closer.on_entry(&key("a", 10), &Payload::LoopWithdrawn(withdraw));
    assert_eq!(closer.decided().count(), 0);
}

fn described(submap: &SubmapId) -> Payload {
    let evidence = crate::log::Evidence { hash: [0; 32], size_bytes: 1 };
    Payload::AnchorDescribed(AnchorDescribed {
        submap: submap.clone(),
        descriptors: Vec::new(),
        coarse: evidence,
        full: evidence,
    })
}

#[test]
fn an_anchor_is_looked_up_again_when_its_window_grows() {
    // 20 frames apart: a window of 25 holds the neighbours only.
    let ids: Vec<SubmapId> = (0..4).map(|n| submap("a", n)).collect();
    let mut closer = closer_with(&ids);
    let mut next = 4;
    let mut describe = |closer: &mut LoopCloser, n: usize| {
        closer.on_entry(&key("a", next), &described(&ids[n]));
        next += 1;
        closer.take_inserts();
        closer.take_queries().iter().map(|id| id.number).collect::<Vec<_>>()
    };
    assert_eq!(describe(&mut closer, 0), [0]);
    assert_eq!(describe(&mut closer, 1), [0, 1]);
    assert_eq!(describe(&mut closer, 3), [3], "2 is not described yet, 1 is too far");
    assert_eq!(describe(&mut closer, 2), [1, 2, 3]);
}

#[test]
fn a_candidate_that_waits_takes_the_similarity_of_the_wider_window() {
    let (x, y) = (submap("a", 0), submap("a", 5));
    let mut closer = closer_with(&[x.clone(), y.clone()]);
    closer.on_candidates(vec![candidate(&x, &y, 0.7)], 0.0);
    closer.on_candidates(vec![candidate(&x, &y, 0.9)], 1.0);
    assert_eq!(closer.pending(), 1);
    assert_eq!(closer.next_to_verify(|_| true, 1.0).unwrap().window_similarity, 0.9);
}

#[test]
fn anchors_without_room_are_left_alone_until_place_recognition_starts_anew() {
    let ids: Vec<SubmapId> = (0..2).map(|n| submap("a", n)).collect();
    let mut closer = closer_with(&ids);
    closer.on_entry(&key("a", 2), &described(&ids[0]));
    closer.on_entry(&key("a", 3), &described(&ids[1]));
    assert_eq!(closer.take_inserts(), ids);
    closer.set_aside(vec![ids[1].clone()]);
    assert_eq!(closer.take_queries(), ids[..1]);
    assert_eq!((closer.inserted(), closer.unqueried()), (1, 0));
    closer.insert_all_again();
    assert_eq!(closer.take_inserts(), ids);
}
