//! One agent's part in a solve: its block, what it knows of the others' standing, and beginning anew when one of them
//! does. A state machine without clock or network.

use coma_pose_graph::SolveError;
use coma_pose_graph::blocks::{BlockAgent, BlockId, Boundary, Standing, Stillness};
use std::collections::BTreeMap;

/// What was heard from a neighbour.
#[derive(Clone, Debug, Default)]
pub struct Heard {
    /// Of the sender's part; `None` where only its attempt is known.
    pub life: Option<u64>,
    /// Which beginning it speaks of.
    pub attempt: u64,
    /// Where its boundary is.
    pub boundary: Option<Boundary>,
    /// What it knows of all.
    pub standings: Vec<Standing>,
}

/// The state of one part.
pub struct Part {
    /// Descends.
    pub agent: BlockAgent,
    /// What is known of all.
    pub stillness: Stillness,
    /// Grows whenever someone began anew.
    pub attempt: u64,
    /// Steps so far.
    pub steps: u64,
    blocks: usize,
    /// Of the neighbours, in this attempt.
    lives: BTreeMap<BlockId, u64>,
}

impl Part {
    /// Begins, one of so many blocks.
    pub fn new(agent: BlockAgent, blocks: usize) -> Self {
        let stillness = Stillness::new(agent.id(), blocks);
        Part { agent, stillness, attempt: 0, steps: 0, blocks, lives: BTreeMap::new() }
    }

    /// Takes what was heard, steps once, and gives what there is to say.
    pub fn advance(
        &mut self,
        heard: impl IntoIterator<Item = (BlockId, Heard)>,
    ) -> Result<Vec<(BlockId, Boundary)>, SolveError> {
        for (from, heard) in heard {
            self.take(from, heard);
        }
        self.stillness.say(self.agent.is_still());
        let out = self.agent.step()?;
        self.steps += 1;
        self.stillness.say(self.agent.is_still());
        Ok(out)
    }

    fn take(&mut self, from: BlockId, heard: Heard) {
        if heard.attempt < self.attempt {
            return;
        }
        if heard.attempt > self.attempt {
            self.begin_anew(heard.attempt);
        }
        let Some(life) = heard.life else { return };
        if *self.lives.entry(from).or_insert(life) != life {
            // It has forgotten what was said to it, and what it has said.
            self.begin_anew(self.attempt.saturating_add(1));
            return;
        }
        heard.standings.iter().for_each(|s| self.stillness.take(s));
        if let Some(boundary) = &heard.boundary {
            self.agent.receive(boundary);
        }
    }

    fn begin_anew(&mut self, attempt: u64) {
        self.attempt = attempt;
        self.lives.clear();
        self.agent.begin_anew();
        self.stillness = Stillness::new(self.agent.id(), self.blocks);
        metrics::counter!("coma_dpgo_block_attempts_total").increment(1);
    }
}
