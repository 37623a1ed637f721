//! Many agents in one process, over a network that loses, delays, repeats and reorders. The same seed gives the same
//! run.

use super::{Block, BlockAgent, BlockId, BlockSettings, Boundary, NodeId};
use crate::solver::SolveError;
use coma_geometry::Pose;
use std::collections::BTreeMap;

/// What the network does to messages.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Network {
    /// Share that is lost.
    pub loss: f64,
    /// Share that arrives twice.
    pub repeated: f64,
    /// Longest delay, in rounds; each message has its own, so that they overtake each other.
    pub delay_rounds: f64,
    /// Seed of all this, and of when agents step.
    pub seed: u64,
}

/// What was said.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Messages sent, lost ones too.
    pub messages: u64,
    /// Their bytes ([`Boundary::bytes`]).
    pub bytes: u64,
}

/// In one round every agent steps once on average.
const TICKS_PER_ROUND: u64 = 16;

/// The agents, the messages on their way, and the time.
pub struct Simulation {
    agents: Vec<BlockAgent>,
    network: Network,
    random: Random,
    tick: u64,
    /// When each agent steps next.
    next_step: Vec<u64>,
    /// By arrival, then in the order of sending.
    on_the_way: BTreeMap<(u64, u64), (BlockId, Boundary)>,
    /// What was said so far.
    pub traffic: Traffic,
}

impl Simulation {
    /// Agents that know their blocks and nothing else; `start` gives the poses of fixed nodes.
    pub fn new(
        blocks: Vec<Block>,
        start: impl Fn(NodeId) -> Pose,
        settings: BlockSettings,
        network: Network,
    ) -> Self {
        let mut random = Random(network.seed);
        let next_step = blocks.iter().map(|_| random.below(TICKS_PER_ROUND)).collect();
        Simulation {
            agents: blocks.into_iter().map(|block| BlockAgent::new(block, &start, settings)).collect(),
            network,
            random,
            tick: 0,
            next_step,
            on_the_way: BTreeMap::new(),
            traffic: Traffic::default(),
        }
    }

    /// The agents, by block.
    pub fn agents(&self) -> &[BlockAgent] {
        &self.agents
    }

    /// Rounds so far.
    pub fn rounds(&self) -> u64 {
        self.tick / TICKS_PER_ROUND
    }

    /// True if no agent has anything to do or to say, and nothing is on its way.
    pub fn is_settled(&self) -> bool {
        self.on_the_way.is_empty() && self.agents.iter().all(BlockAgent::is_settled)
    }

    /// Lets one round pass.
    pub fn round(&mut self) -> Result<(), SolveError> {
        for _ in 0..TICKS_PER_ROUND {
            while let Some(first) = self.on_the_way.first_entry().filter(|e| e.key().0 <= self.tick) {
                let (to, message) = first.remove();
                if let Some(agent) = self.agents.get_mut(to as usize) {
                    agent.receive(&message);
                }
            }
            for k in 0..self.agents.len() {
                if self.next_step[k] > self.tick {
                    continue;
                }
                self.next_step[k] = self.tick + TICKS_PER_ROUND / 2 + self.random.below(TICKS_PER_ROUND + 1);
                for (to, message) in self.agents[k].step()? {
                    self.send(to, message);
                }
            }
            self.tick += 1;
        }
        Ok(())
    }

    fn send(&mut self, to: BlockId, message: Boundary) {
        self.traffic.messages += 1;
        self.traffic.bytes += message.bytes() as u64;
        if self.random.unit() < self.network.loss {
            return;
        }
        let copies = if self.random.unit() < self.network.repeated { 2 } else { 1 };
        for copy in 0..copies {
            let longest = (self.network.delay_rounds * TICKS_PER_ROUND as f64) as u64;
            let arrival = self.tick + 1 + self.random.below(longest + 1);
            self.on_the_way.insert((arrival, 2 * self.traffic.messages + copy), (to, message.clone()));
        }
    }

    /// Every node's pose; `None` for those that have not found their place.
    pub fn poses(&self, nodes: usize) -> Vec<Option<Pose>> {
        let mut out = vec![None; nodes];
        for (node, pose) in self.agents.iter().flat_map(|a| a.poses()) {
            if let Some(slot) = out.get_mut(*node as usize) {
                *slot = Some(*pose);
            }
        }
        out
    }

    /// Every measurement's weight, as the block says that decides on it; `before` for those of nobody.
    pub fn weights(&self, before: &[f64]) -> Vec<f64> {
        let mut out = before.to_vec();
        for (index, weight) in self.agents.iter().flat_map(|a| a.weights()) {
            if let Some(slot) = out.get_mut(index as usize) {
                *slot = weight;
            }
        }
        out
    }
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn below(&mut self, n: u64) -> u64 {
        self.next() % n.max(1)
    }
}
