//! Where every submap lies in the map, by the newest solve of the graph (eq. 13: whole submaps move).

use crate::log::{Hash, SubmapOpened, VersionVector};
use coma_geometry::{MapId, Pose, SubmapId};
use std::collections::BTreeMap;

/// Names one published result.
#[derive(Clone, Debug, PartialEq)]
pub struct Generation {
    /// Which map.
    pub map_id: MapId,
    /// Entries that went in.
    pub cut: VersionVector,
    /// Of the poses.
    pub digest: Hash,
}

/// One connected component's correction: every map_from_submap at once.
#[derive(Clone, Debug, PartialEq)]
pub struct Correction {
    /// Its name.
    pub generation: Generation,
    /// Of every submap in the component.
    pub map_from_submap: BTreeMap<SubmapId, Pose>,
}

/// The newest correction of every component.
#[derive(Clone, Debug, Default)]
pub struct Corrections {
    components: Vec<Correction>,
}

/// Where a submap lies.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed<'a> {
    /// In the map.
    pub map_from_submap: Pose,
    /// By which result; `None` for an agent's own map before any solve.
    pub generation: Option<&'a Generation>,
}

impl Corrections {
    /// Replaces everything: a correction is whole.
    pub fn replace(&mut self, components: Vec<Correction>) {
        self.components = components;
    }

    /// Takes another agent's result of the same map in the place of the own one. False if that map is not there.
    pub fn adopt(&mut self, correction: Correction) -> bool {
        let same_map = |c: &&mut Correction| c.generation.map_id == correction.generation.map_id;
        match self.components.iter_mut().find(same_map) {
            Some(own) => {
                *own = correction;
                true
            }
            None => false,
        }
    }

    /// All components.
    pub fn components(&self) -> &[Correction] {
        &self.components
    }

    /// Where a submap lies: as solved, or composed by odometry with the newest solved submap before it in its
    /// chain; before any solve, in its agent's own frame.
    pub fn place<'a>(
        &'a self,
        opened: &SubmapOpened,
        facts: impl Fn(&SubmapId) -> Option<SubmapOpened>,
    ) -> Placed<'a> {
        for component in &self.components {
            if let Some(pose) = component.map_from_submap.get(&opened.id) {
                return Placed { map_from_submap: *pose, generation: Some(&component.generation) };
            }
        }
        // The newest solved submap of the same chain that came before.
        for component in &self.components {
            let before = component.map_from_submap.range(..&opened.id).rev();
            for (id, map_from_before) in before {
                if id.agent != opened.id.agent || id.epoch != opened.id.epoch {
                    break;
                }
                let Some(earlier) = facts(id) else { continue };
                if earlier.chain == opened.chain {
                    let before_from_submap = earlier.agent_from_submap.inv_mul(&opened.agent_from_submap);
                    return Placed {
                        map_from_submap: map_from_before * before_from_submap,
                        generation: Some(&component.generation),
                    };
                }
            }
        }
        Placed { map_from_submap: opened.agent_from_submap, generation: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{AgentId, Epoch, StampNs};

    fn opened(number: u32, chain: u32) -> SubmapOpened {
        SubmapOpened {
            id: SubmapId { agent: AgentId::new("a").unwrap(), epoch: Epoch(1), number },
            anchor_frame: number as u64,
            anchor_stamp: StampNs(0),
            agent_from_submap: Pose::translation(number as f64, 0.0, 0.0),
            chain,
        }
    }

    #[test]
    fn a_submap_after_the_cut_follows_the_last_solved_one_of_its_chain() {
        let mut corrections = Corrections::default();
        let generation =
            Generation { map_id: MapId::of(&opened(0, 0).id), cut: VersionVector::new(), digest: [0; 32] };
        let solved = BTreeMap::from([(opened(3, 0).id, Pose::translation(10.0, 0.0, 0.0))]);
        corrections.replace(vec![Correction { generation, map_from_submap: solved }]);
        let facts = |id: &SubmapId| Some(opened(id.number, 0));
        let placed = corrections.place(&opened(5, 0), facts);
        assert_eq!(placed.map_from_submap.translation.vector.x, 12.0);
        assert!(placed.generation.is_some());
        // Another chain is tied to nothing.
        assert!(corrections.place(&opened(5, 1), facts).generation.is_none());
    }
}
