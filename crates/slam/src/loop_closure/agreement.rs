//! One result for all: where solvers of different machines differ by a rounding, everyone takes the result of the
//! smallest live agent. No round of talk: each agent's log says what its solver made of a cut, and everyone applies the
//! same rule to what the logs say.

use super::corrections::Generation;
use crate::log::{Hash, SolveDigest, VersionVector};
use coma_geometry::{AgentId, MapId};
use std::collections::BTreeMap;

/// What every agent's solver made of every map, as the logs say it: of each the newest word.
#[derive(Clone, Debug, Default)]
pub struct Agreement {
    said: BTreeMap<MapId, BTreeMap<AgentId, (VersionVector, Hash)>>,
}

impl Agreement {
    /// Takes what an agent's log says.
    pub fn on_digest(&mut self, author: &AgentId, said: &SolveDigest) {
        let of_map = self.said.entry(said.map_id.clone()).or_default();
        of_map.insert(author.clone(), (said.cut.clone(), said.digest));
    }

    /// Whose result is to be taken in the place of this one, and its digest: that of the smallest live agent which has
    /// solved the same cut. `None` if it is the same already, or if `own` is that agent.
    pub fn instead_of(
        &self,
        served: &Generation,
        own: &AgentId,
        is_live: impl Fn(&AgentId) -> bool,
    ) -> Option<(&AgentId, Hash)> {
        let of_cut = self.said.get(&served.map_id)?.iter().filter(|(_, (cut, _))| *cut == served.cut);
        let (author, (_, digest)) = of_cut.into_iter().find(|(agent, _)| *agent == own || is_live(agent))?;
        (author != own && *digest != served.digest).then_some((author, *digest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loop_closure::corrections::{Correction, Corrections};
    use coma_geometry::{Epoch, Matrix6, Pose, SubmapId};
    use coma_pose_graph::graph::NodeInfo;
    use coma_pose_graph::solution::pose_digest;
    use coma_pose_graph::{Component, Edge, EdgeKey, EdgeKind, GlobalSettings, GraphEntries, solve};

    fn agent(name: &str) -> AgentId {
        AgentId::new(name).unwrap()
    }

    fn submap(name: &str, number: u32) -> SubmapId {
        SubmapId { agent: agent(name), epoch: Epoch(1), number }
    }

    /// Two agents that meet twice. Measurements are exact, and one submap lies where the digest's rounding turns over.
    fn on_the_edge() -> GraphEntries {
        let mut entries = GraphEntries::default();
        let mut sequence = 0;
        let mut edge = |kind, from: SubmapId, to: SubmapId, from_from_to| {
            sequence += 1;
            let key = EdgeKey { agent: agent("a"), epoch: Epoch(1), sequence };
            entries.edges.push(Edge {
                key,
                kind,
                from,
                to,
                from_from_to,
                information: Matrix6::identity() * 1e4,
            });
        };
        let step = Pose::translation(0.500_05, 0.0, 0.0);
        for name in ["a", "b"] {
            for number in 1..8 {
                edge(EdgeKind::Odometry, submap(name, number - 1), submap(name, number), step);
            }
        }
        for number in [0, 3, 7] {
            edge(EdgeKind::Loop, submap("a", number), submap("b", number), Pose::translation(0.0, 1.0, 0.0));
        }
        for name in ["a", "b"] {
            for number in 0..8 {
                let node =
                    NodeInfo { first_frame: u64::from(number) * 40, agent_from_submap: Pose::identity() };
                entries.nodes.insert(submap(name, number), node);
            }
        }
        entries
    }

    /// As an agent publishes it.
    fn published(component: &Component) -> Correction {
        let generation = Generation {
            map_id: component.map_id.clone(),
            cut: VersionVector::from([((agent("a"), Epoch(1)), 17)]),
            digest: pose_digest(&component.map_id, &component.map_from_submap),
        };
        Correction { generation, map_from_submap: component.map_from_submap.clone() }
    }

    #[test]
    fn a_solver_that_is_off_by_1e_12_ends_with_the_smallest_live_agent_s_bits() {
        let solution = solve(&on_the_edge(), &GlobalSettings::default());
        assert_eq!(solution.components.len(), 1);
        let exact = solution.components[0].clone();
        let off_by = |m: f64| {
            let mut off = exact.clone();
            off.map_from_submap.values_mut().for_each(|pose| pose.translation.vector.x += m);
            published(&off)
        };
        let (a, b, c) = (off_by(1e-12), off_by(-1e-12), off_by(1e-12));
        assert_ne!(a.generation.digest, b.generation.digest, "the perturbation must show in the digest");
        let mut agreement = Agreement::default();
        for (name, result) in [("b", &b), ("c", &c), ("a", &a)] {
            let Generation { map_id, cut, digest } = result.generation.clone();
            agreement.on_digest(&agent(name), &SolveDigest { map_id, cut, digest });
        }
        let by_author = BTreeMap::from([(agent("a"), &a), (agent("b"), &b), (agent("c"), &c)]);
        let settle = |live: &[&str]| -> Vec<Correction> {
            let is_live = |agent: &AgentId| live.contains(&agent.as_str());
            let settled = live.iter().map(|name| {
                let own = by_author[&agent(name)];
                let mut corrections = Corrections::default();
                corrections.replace(vec![own.clone()]);
                if let Some((author, digest)) = agreement.instead_of(&own.generation, &agent(name), is_live) {
                    assert_eq!(by_author[author].generation.digest, digest);
                    corrections.adopt(by_author[author].clone());
                    // Once is enough.
                    let now = &corrections.components()[0].generation;
                    assert_eq!(agreement.instead_of(now, &agent(name), is_live), None);
                }
                corrections.components()[0].clone()
            });
            settled.collect()
        };
        let bits = |c: &Correction| format!("{c:?}");
        for (live, winner) in [(&["a", "b", "c"][..], &a), (&["b", "c"][..], &b)] {
            assert!(settle(live).iter().all(|c| bits(c) == bits(winner)), "{live:?}");
        }
    }

    #[test]
    fn results_of_other_cuts_and_other_maps_are_not_compared() {
        let map_id = MapId::of(&submap("a", 0));
        let cut = |length| VersionVector::from([((agent("a"), Epoch(1)), length)]);
        let served = Generation { map_id: map_id.clone(), cut: cut(5), digest: [1; 32] };
        let mut agreement = Agreement::default();
        let said = |map_id: &MapId, length| SolveDigest {
            map_id: map_id.clone(),
            cut: cut(length),
            digest: [2; 32],
        };
        agreement.on_digest(&agent("a"), &said(&map_id, 4));
        agreement.on_digest(&agent("b"), &said(&MapId::of(&submap("a", 7)), 5));
        assert_eq!(agreement.instead_of(&served, &agent("c"), |_| true), None);
        agreement.on_digest(&agent("a"), &said(&map_id, 5));
        assert_eq!(agreement.instead_of(&served, &agent("c"), |_| true), Some((&agent("a"), [2; 32])));
        assert_eq!(agreement.instead_of(&served, &agent("c"), |_| false), None);
    }
}
