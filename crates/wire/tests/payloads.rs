//! Payloads: they survive the wire bit for bit, and foreign bytes are refused without a panic.

use coma_geometry::{AgentId, Epoch, MapId, Matrix6, Pose, StampNs, SubmapId};
use coma_place::{Descriptor, Space};
use coma_slam::log::*;
use coma_wire::{At, Wire, decode_payload, encode_payload, v1};
use nalgebra::Vector3;
use proptest::prelude::*;
use prost::Message;
use std::collections::BTreeMap;

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn submap(number: u32) -> SubmapId {
    SubmapId { agent: agent("agent-00"), epoch: Epoch(3), number }
}

fn poses() -> impl Strategy<Value = Pose> {
    let vector = || prop::array::uniform3(-100.0..100.0f64).prop_map(Vector3::from);
    (vector(), prop::array::uniform3(-3.0..3.0f64)).prop_map(|(t, r)| Pose::new(t, Vector3::from(r)))
}

fn matrices() -> impl Strategy<Value = Matrix6> {
    prop::array::uniform32(-10.0..10.0f64).prop_map(|v| {
        let a = Matrix6::from_fn(|r, c| v[(r * 6 + c) % 32]);
        let product = a * a.transpose() + Matrix6::identity();
        (product + product.transpose()) * 0.5
    })
}

fn numbers() -> impl Strategy<Value = BTreeMap<String, f64>> {
    prop::collection::btree_map("[a-z_]{1,20}", -1e6..1e6f64, 0..8)
}

fn evidence() -> impl Strategy<Value = Evidence> {
    (any::<[u8; 32]>(), any::<u64>()).prop_map(|(hash, size_bytes)| Evidence { hash, size_bytes })
}

fn descriptors() -> impl Strategy<Value = Descriptor> {
    ("[a-z/0-9]{1,30}", 1e-4..1.0f32, prop::collection::vec(any::<i8>(), 1..64)).prop_map(
        |(space, scale, mut values)| {
            // All zero is no direction.
            values[0] |= 1;
            Descriptor::new(Space::new(&space).unwrap(), scale, values).unwrap()
        },
    )
}

fn outcomes() -> impl Strategy<Value = LoopOutcome> {
    prop_oneof![
        (poses(), matrices(), numbers()).prop_map(|(from_from_to, information, numbers)| {
            LoopOutcome::Accepted { from_from_to, information, numbers }
        }),
        ("[a-z_]{1,20}", ".{0,100}", numbers())
            .prop_map(|(reason, message, numbers)| LoopOutcome::Rejected { reason, message, numbers }),
    ]
}

fn payloads() -> impl Strategy<Value = Payload> {
    prop_oneof![
        (any::<u32>(), "[ -~]{0,40}").prop_map(|(anchor_priority, build)| Payload::AgentStarted(
            AgentStarted { anchor_priority, build }
        )),
        (any::<u32>(), any::<u64>(), any::<i64>(), poses(), any::<u32>()).prop_map(
            |(n, f, s, pose, chain)| {
                Payload::SubmapOpened(SubmapOpened {
                    id: submap(n),
                    anchor_frame: f,
                    anchor_stamp: StampNs(s),
                    agent_from_submap: pose,
                    chain,
                })
            }
        ),
        (any::<u32>(), any::<u32>(), poses(), matrices()).prop_map(|(a, b, pose, information)| {
            Payload::OdometryEdge(OdometryEdge {
                from: submap(a),
                to: submap(b),
                from_from_to: pose,
                information,
            })
        }),
        (any::<u32>(), prop::collection::vec(descriptors(), 0..4), evidence(), evidence()).prop_map(
            |(n, descriptors, coarse, full)| {
                Payload::AnchorDescribed(AnchorDescribed { submap: submap(n), descriptors, coarse, full })
            }
        ),
        (any::<u32>(), any::<u32>(), -1.0..1.0f32, outcomes()).prop_map(|(a, b, similarity, outcome)| {
            Payload::LoopVerdict(LoopVerdict {
                from: submap(a),
                to: submap(b),
                similarity,
                space: "builtin/1".into(),
                outcome,
            })
        }),
        (any::<u64>(), ".{0,100}").prop_map(|(sequence, message)| {
            let verdict = EntryKey { agent: agent("b"), epoch: Epoch(1), sequence };
            Payload::LoopWithdrawn(LoopWithdrawn { verdict, message })
        }),
        (any::<[u8; 32]>(), any::<u32>(), prop::collection::btree_map("[a-z]{1,8}", any::<u64>(), 0..5))
            .prop_map(|(digest, first_submap, heads)| {
                let cut = heads.into_iter().map(|(name, length)| ((agent(&name), Epoch(length % 7)), length));
                Payload::SolveDigest(SolveDigest {
                    map_id: MapId { agent: agent("a"), epoch: Epoch(2), first_submap },
                    cut: cut.collect(),
                    digest,
                })
            }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn a_payload_survives_the_wire(payload in payloads()) {
        let bytes = encode_payload(&payload);
        prop_assert_eq!(&decode_payload(&bytes).unwrap(), &payload);
        prop_assert_eq!(encode_payload(&payload), bytes);
    }

    #[test]
    fn damaged_payloads_are_read_or_refused_but_never_panic(
        payload in payloads(),
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        length in any::<prop::sample::Index>(),
    ) {
        let mut bytes = encode_payload(&payload);
        prop_assume!(!bytes.is_empty());
        for (at, value) in damage {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        for bytes in [&bytes[..], &bytes[..length.index(bytes.len())]] {
            match decode_payload(bytes) {
                // What was let in can be written and is let in again.
                Ok(read) => prop_assert_eq!(decode_payload(&encode_payload(&read)).unwrap(), read),
                Err(error) => prop_assert!(error.field.starts_with("payload"), "{}", error),
            }
        }
    }

    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = decode_payload(&bytes);
        if let Ok(message) = v1::Calibration::decode(&bytes[..]) {
            let _ = coma_wire::Calibration::from_wire(message, &At::ROOT);
        }
        if let Ok(message) = v1::Entry::decode(&bytes[..]) {
            let _ = Entry::from_wire(message, &At::ROOT);
        }
        if let Ok(message) = v1::VersionVector::decode(&bytes[..]) {
            let _ = VersionVector::from_wire(message, &At::ROOT);
        }
    }

    #[test]
    fn a_calibration_of_any_numbers_is_valid_or_refused(values in prop::collection::vec(any::<f64>(), 12)) {
        let v = &values;
        let message = v1::Calibration {
            color: Some(v1::Intrinsics { width: 640, height: 480, fx: v[0], fy: v[1], cx: v[2], cy: v[3] }),
            color_distortion: Some(v1::Distortion { k1: v[4], k2: v[5], ..Default::default() }),
            depth_units_per_metre: v[6],
            depth_noise: Some(v1::DepthNoise { base_m: v[7], quadratic_per_m: v[8] }),
            depth_min_m: v[9],
            depth_max_m: v[10],
            rolling_shutter_s: v[11],
            ..Default::default()
        };
        if let Ok(read) = coma_wire::Calibration::from_wire(message, &At::ROOT) {
            prop_assert!(read.color.validated().is_ok() && read.depth_units_per_metre.is_finite());
        }
    }
}

#[test]
fn what_others_could_not_read_is_not_written() {
    let verdict = |message: &str, number| LoopVerdict {
        from: submap(0),
        to: submap(1),
        similarity: 0.5,
        space: "builtin/1".into(),
        outcome: LoopOutcome::Rejected {
            reason: "low_overlap".into(),
            message: message.into(),
            numbers: BTreeMap::from([("overlap".into(), number), ("fitness".into(), 0.5)]),
        },
    };
    let written = encode_payload(&Payload::LoopVerdict(verdict(&"ä".repeat(2000), f64::NAN)));
    let Payload::LoopVerdict(read) = decode_payload(&written).unwrap() else { panic!() };
    let LoopOutcome::Rejected { message, numbers, .. } = read.outcome else { panic!() };
    assert_eq!(message.len(), 1024);
    assert_eq!(numbers, BTreeMap::from([("fitness".into(), 0.5)]));
}

#[test]
fn a_payload_of_a_newer_version_is_refused_by_name_and_its_entry_is_kept() {
    // Field 200, length-delimited, empty.
    let newer = vec![0xc2, 0x0c, 0x00];
    assert_eq!(decode_payload(&newer).unwrap_err().field, "payload.kind");
    let key = EntryKey { agent: agent("a"), epoch: Epoch(1), sequence: 1 };
    let entry = Entry { key, previous_hash: Some([1; 32]), payload: newer, signature: vec![] };
    assert_eq!(Entry::from_wire(entry.to_wire(), &At::ROOT).unwrap(), entry);
}

#[test]
fn entries_name_the_field_at_fault() {
    let key = EntryKey { agent: agent("a"), epoch: Epoch(1), sequence: 1 };
    let good = Entry { key, previous_hash: Some([1; 32]), payload: vec![], signature: vec![] }.to_wire();
    let entries = At::Root("entries");
    let refused = |m: v1::Entry| Entry::from_wire(m, &entries.index(4)).unwrap_err().field;
    assert_eq!(refused(v1::Entry { key: None, ..good.clone() }), "entries[4].key");
    assert_eq!(
        refused(v1::Entry { previous_hash: vec![1; 31].into(), ..good.clone() }),
        "entries[4].previous_hash"
    );
    assert_eq!(refused(v1::Entry { payload: vec![0; 300_000].into(), ..good.clone() }), "entries[4].payload");
    let mut shouting = good;
    shouting.key.as_mut().unwrap().agent_id = "AGENT".into();
    assert_eq!(refused(shouting), "entries[4].key.agent_id");
}

#[test]
fn a_version_vector_names_each_log_once() {
    let head = v1::LogHead { agent_id: "a".into(), epoch: 1, length: 4 };
    let at = At::Root("have");
    let twice = v1::VersionVector { heads: vec![head.clone(), head.clone()] };
    assert_eq!(VersionVector::from_wire(twice, &at).unwrap_err().field, "have.heads[1]");
    let many = v1::VersionVector { heads: vec![head; 5000] };
    assert_eq!(VersionVector::from_wire(many, &at).unwrap_err().message, "5000 logs, at most 4096 are taken");
}
