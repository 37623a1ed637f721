//! The solved graph as a g2o file: vertices as solved, odometry and accepted loops as measured.

use coma_geometry::{Matrix6, Pose, SubmapId};
use coma_pose_graph::g2o::{G2oEdge, G2oGraph};
use coma_slam::log::{EntryKey, LoopOutcome, Payload};
use coma_wire::{At, v1};
use std::collections::BTreeMap;

/// Vertices are numbered in the order of submap ids, over all components.
pub fn text(graph: &v1::GetGraphResponse, entries: &[(EntryKey, Payload)]) -> anyhow::Result<String> {
    let mut poses: BTreeMap<SubmapId, Pose> = BTreeMap::new();
    let at = At::Root("components.poses");
    for pose in graph.components.iter().flat_map(|c| &c.poses) {
        let id: SubmapId = at.field("submap_id").required(pose.submap_id.clone())?;
        poses.insert(id, at.field("map_from_submap").required(pose.map_from_submap)?);
    }
    let number: BTreeMap<&SubmapId, u64> = poses.keys().zip(0..).collect();
    let mut out = G2oGraph {
        vertices: poses.values().copied().zip(0..).map(|(p, i)| (i, p)).collect(),
        ..G2oGraph::default()
    };
    let mut edge = |from: &SubmapId, to: &SubmapId, from_from_to: &Pose, information: &Matrix6| {
        if let (Some(from), Some(to)) = (number.get(from), number.get(to)) {
            out.edges.push(G2oEdge {
                from: *from,
                to: *to,
                from_from_to: *from_from_to,
                information: *information,
            });
        }
    };
    for (_, payload) in entries {
        match payload {
            Payload::OdometryEdge(e) => edge(&e.from, &e.to, &e.from_from_to, &e.information),
            Payload::LoopVerdict(v) => {
                if let LoopOutcome::Accepted { from_from_to, information, .. } = &v.outcome {
                    edge(&v.from, &v.to, from_from_to, information);
                }
            }
            _ => {}
        }
    }
    let names: String = number.iter().map(|(id, n)| format!("# {n} = {id}\n")).collect();
    Ok(names + &out.to_text())
}
