//! What became of the candidates for loops.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Candidates by verdict.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct LoopCounts {
    /// Verified, within one agent.
    pub accepted_within: usize,
    /// Verified, between two agents.
    pub accepted_between: usize,
    /// Without a verdict at the end.
    pub pending: usize,
    /// Accepted once, then withdrawn by its author.
    pub withdrawn: usize,
    /// Rejected, by the name of the reason.
    pub rejected: BTreeMap<String, usize>,
}

impl LoopCounts {
    /// Verified, of both kinds.
    pub fn accepted(&self) -> usize {
        self.accepted_within + self.accepted_between
    }

    /// Rejected for any reason.
    pub fn rejected(&self) -> usize {
        self.rejected.values().sum()
    }

    /// Counts one rejection.
    pub fn add_rejected(&mut self, reason: &str) {
        *self.rejected.entry(reason.to_owned()).or_default() += 1;
    }
}
